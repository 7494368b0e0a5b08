// The path of one robot with the fewest conflicts, whatever its length: the low level of repair and improvement.
//
// Safe interval path planning (SIPP) with soft obstacles, "SIPPS" in the source below. The time line of each cell is
// cut into intervals during which nothing changes; a busy one is occupied by another robot, and entering it is a
// conflict:
//
//     cell X:   0 -- free -- 4 | 4 - busy - 5 | 5 ----- free ----> forever
//     cell Y:   0 ------------ free --------- 7 | 7 -- busy -- 8 | 8 --> forever
//
// A state is (cell, interval, earliest time of arrival): waiting within an interval is not a step of the search. The
// edge from X's first interval to Y's first one leads to the earliest time at which the robot can enter Y from X.
//
// Each turn of the loop in run():
//     1. pop the state with the fewest conflicts, among those the one with the lowest f = time + distance to the goal
//     2. dominance: skip it if its interval was expanded from an earlier time already
//     3. goal test: the robot can rest on its goal if the robots that pass there later are tolerated as conflicts
//     4. successors: all intervals of the four neighbour cells that begin before this interval ends
//
// Invariant: states are popped by ascending number of conflicts, so the first one that passes the goal test has the
// fewest possible, and the least arrival time among paths with as many.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/pair_table.hpp"
#include "experts/native/reservations.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// Safe interval path planning with soft obstacles (Li, Chen, Harabor, Stuckey and Koenig 2022, "MAPF-LNS2: fast
// repairing for multi-agent path finding via large neighborhood search"): a state is a cell and one of its intervals,
// so waiting costs nothing to search. Paths are found in the order of their conflicts, then of their length.
class SafeIntervalSearch {
public:
    // Returns true if there is a path that enters at most `tolerance` busy intervals and arrives by `latest`. It is then
    // in actions() until the next search.
    bool run(const Grid& grid, const Reservations& others, int start, int goal, const Distance* distance, int tolerance,
             int latest, Budget& budget);

    const std::vector<std::uint8_t>& actions() const { return actions_; }

private:
    struct State {
        int cell, time, end, parent, meetings;  // `end` of the interval; `meetings` are conflicts so far
        bool arrived;
    };
    struct Reached {
        int expanded = forever;                  // the earliest time from which it was expanded
        int time = forever, meetings = forever;  // the last open entry with the fewest meetings
    };
    struct Open {
        int length, distance, id;
    };

    static bool is_worse(const Open& a, const Open& b) {
        if (a.length != b.length) return a.length > b.length;
        if (a.distance != b.distance) return a.distance > b.distance;
        return a.id > b.id;
    }

    void expand(int id);
    void enter(int from, int cell, const Interval& interval);
    void reach(int parent, int cell, int time, const Interval& interval, int meetings);
    void push(const State& state);
    int pop();
    void trace(int id);

    const Reservations* others_ = nullptr;
    const Distance* distance_ = nullptr;
    std::array<int, num_actions> steps_{};
    int goal_ = 0, earliest_ = 0, tolerance_ = 0, latest_ = 0;

    std::vector<State> states_;
    PairTable<Reached> reached_;       // by cell and end of the interval
    std::vector<std::vector<Open>> open_;  // by meetings; heaps
    std::size_t fewest_ = 0;
    std::vector<std::uint8_t> actions_;
};

}  // namespace mapf
