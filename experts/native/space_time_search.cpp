#include "experts/native/space_time_search.hpp"

#include <algorithm>
#include <utility>

namespace mapf {

bool SpaceTimeSearch::run(const Layout& layout, const Traffic& traffic, const Journey& journey, Budget& budget) {
    traffic_ = &traffic;
    journey_ = journey;
    steps_ = layout.steps();
    level_ = std::max<int>(journey.distance[journey.start], journey.earliest);
    states_.clear();
    reached_.clear();
    rim_.clear();
    older_rim_.clear();
    for (auto& stack : stacks_) stack.clear();
    fewest_ = stacks_.size();

    states_.push_back({journey.start, 0, -1, 0, idle});
    reached_(journey.start, 0).conflicts = 0;
    push(0, 0);
    if (journey.start == journey.goal) arrive(0);
    while (!budget.spent()) {
        const int id = pop();
        if (id == exhausted) {
            if (rim_.empty() && older_rim_.empty()) return false;
            begin_level();
        } else if (id < 0) {
            trace(~id);
            return true;
        } else if (const auto& state = states_[id]; reached_.at(state.cell, state.time).conflicts == state.conflicts) {
            expand(id);  // else a better way to this state was found since
        }
    }
    return false;
}

void SpaceTimeSearch::expand(int id) {
    const int slack = level_ - states_[id].time - journey_.distance[states_[id].cell];
    if (slack >= 2) move(id, +1);
    if (slack >= 1) pause(id);
    move(id, -1);
    if (slack == 0) rim_.push_back(id);
    if (slack == 1) older_rim_.push_back(id);
}

void SpaceTimeSearch::begin_level() {
    ++level_;
    for (const int id : older_rim_) move(id, +1);
    for (const int id : rim_) pause(id);
    older_rim_.clear();
    std::swap(rim_, older_rim_);
}

// All moves to cells whose distance to the goal differs by `distance_change`.
void SpaceTimeSearch::move(int id, int distance_change) {
    const int cell = states_[id].cell;
    const int wanted = journey_.distance[cell] + distance_change;
    const auto& traffic_here = traffic_->at(cell, states_[id].time + 1);
    for (int action = idle - 1; action >= 0; --action)
        if (journey_.distance[cell + steps_[action]] == wanted) step(id, action, traffic_here);
}

void SpaceTimeSearch::pause(int id) { step(id, idle, {}); }

void SpaceTimeSearch::step(int id, int action, const Passage& traffic_here) {
    const int cell = states_[id].cell + steps_[action], time = states_[id].time + 1;
    const auto& passage = traffic_->at(cell, time);
    if (passage.forbidden >> action & 1) return;
    const int swaps = action == idle ? 0 : traffic_here.by_move[reversed(action)];
    const int conflicts = states_[id].conflicts + swaps + traffic_->vertex_conflicts(passage, cell, time);
    auto& reached = reached_(cell, time).conflicts;
    if (reached >= 0 && reached <= conflicts) return;
    reached = conflicts;
    const int next = static_cast<int>(states_.size());
    states_.push_back({cell, time, id, conflicts, static_cast<std::uint8_t>(action)});
    push(next, conflicts);
    if (cell == journey_.goal) arrive(next);
}

// The robot stands on its goal: if it may stay there forever, the search ends.
void SpaceTimeSearch::arrive(int id) {
    const auto& state = states_[id];
    if (state.time < journey_.earliest) return;
    push(~id, state.conflicts + traffic_->visits_after(state.cell, state.time));
}

void SpaceTimeSearch::push(int id, int conflicts) {
    const auto stack = static_cast<std::size_t>(conflicts);
    if (stack >= stacks_.size()) stacks_.resize(stack + 1);
    stacks_[stack].push_back(id);
    fewest_ = std::min(fewest_, stack);
}

int SpaceTimeSearch::pop() {
    while (fewest_ < stacks_.size() && stacks_[fewest_].empty()) ++fewest_;
    if (fewest_ == stacks_.size()) return exhausted;
    const int id = stacks_[fewest_].back();
    stacks_[fewest_].pop_back();
    return id;
}

void SpaceTimeSearch::trace(int id) {
    conflicts_ = states_[id].conflicts + traffic_->visits_after(states_[id].cell, states_[id].time);
    actions_.resize(static_cast<std::size_t>(states_[id].time));
    for (; states_[id].parent >= 0; id = states_[id].parent) actions_[states_[id].time - 1] = states_[id].action;
}

}  // namespace mapf
