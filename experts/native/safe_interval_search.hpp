// The path of one robot that meets the fewest others, whatever its length: the low level of repair and improvement.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/cell_time_table.hpp"
#include "experts/native/reservations.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// Safe interval path planning with soft obstacles (Li, Chen, Harabor, Stuckey and Koenig 2022, "MAPF-LNS2: fast
// repairing for multi-agent path finding via large neighborhood search"): a state is a cell and one of its intervals,
// so waiting costs nothing to search. Paths come in the order of the busy intervals they enter, then of their length.
class SafeIntervalSearch {
public:
    // Returns true if there is a path that enters at most `tolerance` busy intervals and arrives by `latest`. It is then
    // in actions() until the next search.
    bool run(const Grid& grid, const Reservations& others, int start, int goal, const Distance* distance, int tolerance,
             int latest, Budget& budget);

    const std::vector<std::uint8_t>& actions() const { return actions_; }

private:
    struct State {
        int cell, time, end, parent, meetings;  // the robot may stay until the interval's end
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
    CellTimeTable<Reached> reached_;       // by cell and end of the interval
    std::vector<std::vector<Open>> open_;  // by meetings; heaps
    std::size_t fewest_ = 0;
    std::vector<std::uint8_t> actions_;
};

}  // namespace mapf
