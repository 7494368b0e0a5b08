// The robots in each cell by time: the input of a search over safe intervals.
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
    // A robot is in a cell at `time`.
    struct Visit {
        int time, robot;
    };

    // The first of a cell's visits that is not before `time`.
    template <class Visits>
    static auto from(Visits& visits, int time) {
        return std::lower_bound(visits.begin(), visits.end(), time,
                                [](const Visit& visit, int wanted) { return visit.time < wanted; });
    }

public:
    void reset(const Layout& layout) {
        steps_ = layout.steps();
        for (auto& visits : visits_) visits.clear();
        visits_.resize(static_cast<std::size_t>(layout.size()));
        rests_.assign(static_cast<std::size_t>(layout.size()), Rest{});
    }

    void add(int robot, const PathView& path) {
        follow(path, [&](int cell, int time) {
            auto& visits = visits_[cell];
            visits.insert(from(visits, time + 1), {time, robot});
        });
        rests_[end_of(path)] = {path.arrival_time(), robot};
    }

    void remove(int robot, const PathView& path) {
        follow(path, [&](int cell, int time) {
            auto& visits = visits_[cell];
            auto visit = from(visits, time);
            while (visit->robot != robot) ++visit;
            visits.erase(visit);
        });
        rests_[end_of(path)] = {};
    }

    // The robot that stays in `cell`, and the time from which it does.
    Rest rest(int cell) const { return rests_[cell]; }

    // Calls use(robot) for each robot that is in `cell` at `time` and has not come to rest there before.
    template <class Use>
    void visitors(int cell, int time, const Use& use) const {
        const auto& visits = visits_[cell];
        for (auto visit = from(visits, time); visit != visits.end() && visit->time == time; ++visit) use(visit->robot);
    }

    // The last time at which a robot comes to `cell`, -1 if none does.
    int last_visit(int cell) const { return visits_[cell].empty() ? -1 : visits_[cell].back().time; }

    // A robot that moves from `to` into `from` during the step that ends at `time`, or -1.
    int opposing(int from, int to, int time) const {
        int found = -1;
        visitors(to, time - 1, [&](int robot) {
            if (is_in(robot, from, time)) found = robot;
        });
        return found;
    }

    // Calls use(interval) for the intervals of `cell` in the order of time that end after `time` and begin by `until`. The
    // first of them may have begun before the `begin` that is given.
    template <class Use>
    void intervals(int cell, int time, int until, const Use& use) const {
        const int rest = rests_[cell].time;
        const auto& visits = visits_[cell];
        auto visit = from(visits, time);
        for (int begin = time; begin <= until;) {
            const int busy = visit == visits.end() ? rest : std::min(visit->time, rest);
            if (begin < busy) {
                use(Interval{begin, busy, false});
                begin = busy;
                continue;
            }
            if (begin == forever) return;
            int end = begin;
            for (; visit != visits.end() && visit->time <= end; ++visit) end = visit->time + 1;
            if (rest <= end) end = forever;
            use(Interval{begin, end, true});
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
        const auto& visits = visits_[before];
        for (auto visit = from(visits, path.arrival_time() + 1); visit != visits.end(); ++visit) meet(visit->robot);
    }

private:
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

    std::array<int, num_actions> steps_{};
    std::vector<std::vector<Visit>> visits_;  // of each cell, in the order of time
    std::vector<Rest> rests_;
};

}  // namespace mapf
