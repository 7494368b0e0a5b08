// Who is in a cell and when, cell by cell: what a search over safe intervals reads.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

#include "experts/native/traffic.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// A robot that stays in a cell from `time` on, or nobody and `forever`.
struct Rest {
    int time = forever, robot = -1;
};

// The times begin..end-1 during which a cell is all free or all busy.
struct Interval {
    int begin, end;
    bool busy;
};

class Reservations {
public:
    void reset(const Layout& layout) {
        steps_ = layout.steps();
        visits_.clear();
        unused_ = nothing;
        first_.assign(static_cast<std::size_t>(layout.size()), nothing);
        rests_.assign(static_cast<std::size_t>(layout.size()), Rest{});
    }

    void add(int robot, const PathView& path) {
        follow(path, [&](int cell, int time) {
            const int id = take_unused();
            int* place = &first_[cell];
            while (*place != nothing && visits_[*place].time <= time) place = &visits_[*place].next;
            visits_[id] = {time, robot, *place};
            *place = id;
        });
        rests_[end_of(path)] = {path.arrival(), robot};
    }

    void remove(int robot, const PathView& path) {
        follow(path, [&](int cell, int time) {
            int* place = &first_[cell];
            while (visits_[*place].time != time || visits_[*place].robot != robot) place = &visits_[*place].next;
            const int id = *place;
            *place = visits_[id].next;
            visits_[id].next = unused_;
            unused_ = id;
        });
        rests_[end_of(path)] = {};
    }

    // Who stays in `cell`, and from when on.
    Rest rest(int cell) const { return rests_[cell]; }

    // Calls use(robot) for each robot that is in `cell` at `time` and has not come to rest there before.
    template <class Use>
    void visitors(int cell, int time, const Use& use) const {
        for (const Visit* visit = first(cell); visit && visit->time <= time; visit = next(*visit))
            if (visit->time == time) use(visit->robot);
    }

    // The last time at which a robot comes to `cell`, -1 if none does.
    int last_visit(int cell) const {
        int last = -1;
        for (const Visit* visit = first(cell); visit; visit = next(*visit)) last = visit->time;
        return last;
    }

    // A robot that moves from `to` into `from` during the step that ends at `time`, or -1.
    int opposing(int from, int to, int time) const {
        int found = -1;
        visitors(to, time - 1, [&](int robot) {
            if (is_in(robot, from, time)) found = robot;
        });
        return found;
    }

    // Calls use(interval) for the intervals of `cell` in the order of time that end after `from` and begin by `until`.
    template <class Use>
    void intervals(int cell, int from, int until, const Use& use) const {
        const int rest = rests_[cell].time;
        const Visit* visit = first(cell);
        for (int begin = 0; begin <= until;) {
            const int busy = visit ? std::min(visit->time, rest) : rest;
            if (begin < busy) {
                if (busy > from) use(Interval{begin, busy, false});
                begin = busy;
                continue;
            }
            if (begin == forever) return;
            int end = begin;
            for (; visit && visit->time <= end; visit = next(*visit)) end = visit->time + 1;
            if (rest <= end) end = forever;
            if (end > from) use(Interval{begin, end, true});
            if (end == forever) return;
            begin = end;
        }
    }

    // Calls use(robot) for each meeting of `path` with another robot, which may be met more than once.
    template <class Use>
    void meetings(int robot, const PathView& path, const Use& use) const {
        const auto meet = [&](int other) {
            if (other != robot) use(other);
        };
        int before = path.start;
        follow(path, [&](int cell, int time) {
            visitors(cell, time, meet);
            if (rests_[cell].time < time) meet(rests_[cell].robot);
            if (cell != before)
                visitors(before, time, [&](int other) {
                    if (is_in(other, cell, time - 1)) meet(other);
                });
            before = cell;
        });
        for (const Visit* visit = first(before); visit; visit = next(*visit))
            if (visit->time > path.arrival()) meet(visit->robot);
    }

private:
    static constexpr int nothing = -1;

    // A robot is in a cell at `time`.
    struct Visit {
        int time = 0, robot = 0, next = nothing;
    };

    template <class Use>
    void follow(const PathView& path, const Use& use) const {
        int cell = path.start, time = 0;
        use(cell, time);
        for (const int action : path.actions) use(cell += steps_[action], ++time);
    }

    int end_of(const PathView& path) const {
        int cell = path.start;
        for (const int action : path.actions) cell += steps_[action];
        return cell;
    }

    bool is_in(int robot, int cell, int time) const {
        bool found = false;
        visitors(cell, time, [&](int other) { found |= other == robot; });
        return found;
    }

    const Visit* first(int cell) const { return at(first_[cell]); }
    const Visit* next(const Visit& visit) const { return at(visit.next); }
    const Visit* at(int id) const { return id == nothing ? nullptr : &visits_[static_cast<std::size_t>(id)]; }

    int take_unused() {
        if (unused_ == nothing) {
            visits_.emplace_back();
            return static_cast<int>(visits_.size()) - 1;
        }
        const int id = unused_;
        unused_ = visits_[id].next;
        return id;
    }

    std::array<int, num_actions> steps_{};
    std::vector<Visit> visits_;  // of all cells; the visits of a cell are a list in the order of time
    std::vector<int> first_;     // of each cell
    std::vector<Rest> rests_;
    int unused_ = nothing;  // the first of a list, too
};

}  // namespace mapf
