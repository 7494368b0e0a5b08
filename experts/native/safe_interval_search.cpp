#include "experts/native/safe_interval_search.hpp"

#include <algorithm>

namespace mapf {

bool SafeIntervalSearch::run(const Grid& grid, const Reservations& others, int start, int goal,
                             const Distance* distance, int tolerance, int latest, Budget& budget) {
    others_ = &others;
    distance_ = distance;
    steps_ = grid.layout.steps();
    goal_ = goal;
    earliest_ = others.last_visit(goal) + 1;
    tolerance_ = tolerance;
    latest_ = latest;
    states_.clear();
    reached_.clear();
    for (auto& heap : open_) heap.clear();
    fewest_ = open_.size();

    // The start state: the interval of the start cell that holds time 0.
    others.intervals(start, 0, 0, [&](const Interval& interval) { reach(-1, start, 0, interval, 0); });
    while (!budget.spent()) {
        // 1. Pop the state with the fewest conflicts, then the lowest f = time + distance.
        const int id = pop();
        if (id < 0) return false;
        const auto state = states_[id];
        if (state.arrived) {
            trace(id);
            return true;
        }
        // 2. Dominance: a state of the same interval that was expanded from an earlier time covers this one.
        auto& expanded = reached_(state.cell, state.end).expanded;
        if (expanded <= state.time) continue;
        expanded = state.time;
        expand(id);
    }
    return false;
}

void SafeIntervalSearch::expand(int id) {
    const auto state = states_[id];
    // 3. Goal test: the robot may rest here if it tolerates the robots that pass later.
    if (state.cell == goal_) {
        int later = 0;
        if (state.end != forever)
            others_->intervals(goal_, state.end, forever - 1, [&](const Interval& each) { later += each.busy; });
        if (state.meetings + later <= tolerance_) {
            auto end = state;
            end.meetings += later;
            end.parent = id;
            end.arrived = true;
            push(end);
        }
    }
    // 4. Successors: every interval of a neighbour cell that begins before this interval ends.
    for (int action = 0; action < idle; ++action) {
        const int cell = state.cell + steps_[action];
        if (distance_[cell] == unreachable) continue;
        others_->intervals(cell, state.time + 1, state.end, [&](const Interval& interval) { enter(id, cell, interval); });
    }
}

// Moves into `cell` as early as possible during `interval`, and also later if that avoids a swap conflict.
void SafeIntervalSearch::enter(int from, int cell, const Interval& interval) {
    const auto state = states_[from];
    const int last = std::min(state.end, interval.end - 1);
    for (int time = std::max(state.time + 1, interval.begin); time <= last; ++time) {
        const bool opposed = others_->opposing(state.cell, cell, time) >= 0;
        reach(from, cell, time, interval, state.meetings + interval.busy + opposed);
        if (!opposed) return;
    }
}

void SafeIntervalSearch::reach(int parent, int cell, int time, const Interval& interval, int meetings) {
    if (meetings > tolerance_) return;
    auto& best = reached_(cell, interval.end);
    if (best.expanded <= time || (best.time <= time && best.meetings <= meetings)) return;
    if (meetings <= best.meetings) best = {best.expanded, time, meetings};
    push({cell, time, interval.end, parent, meetings, false});
}

void SafeIntervalSearch::push(const State& state) {
    const int distance = distance_[state.cell];
    const int length = state.arrived ? state.time : std::max(state.time + distance, earliest_);
    if (length > latest_) return;
    const auto heap = static_cast<std::size_t>(state.meetings);
    if (heap >= open_.size()) open_.resize(heap + 1);
    open_[heap].push_back({length, distance - state.arrived, static_cast<int>(states_.size())});
    std::push_heap(open_[heap].begin(), open_[heap].end(), is_worse);
    states_.push_back(state);
    fewest_ = std::min(fewest_, heap);
}

int SafeIntervalSearch::pop() {
    while (fewest_ < open_.size() && open_[fewest_].empty()) ++fewest_;
    if (fewest_ >= open_.size()) return -1;
    auto& heap = open_[fewest_];
    std::pop_heap(heap.begin(), heap.end(), is_worse);
    const int id = heap.back().id;
    heap.pop_back();
    return id;
}

void SafeIntervalSearch::trace(int id) {
    actions_.assign(static_cast<std::size_t>(states_[id].time), static_cast<std::uint8_t>(idle));
    for (; states_[id].parent >= 0; id = states_[id].parent) {
        const int before = states_[states_[id].parent].cell;
        for (int action = 0; action < idle; ++action)
            if (before + steps_[action] == states_[id].cell && !states_[id].arrived)
                actions_[states_[id].time - 1] = static_cast<std::uint8_t>(action);
    }
}

}  // namespace mapf
