// The low level of ECBS: the path of one robot through the traffic of the others.
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/pair_table.hpp"
#include "experts/native/traffic.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

struct Journey {
    int start, goal;
    const Distance* distance;  // to the goal, for each cell
    int earliest;              // the robot may not come to rest on its goal before this time
};

// Space-time A*: among the earliest arrivals, all constraints obeyed, one with the fewest conflicts with the traffic.
//
// The clock is the cost so far, so a state (cell, time) has one estimate e = time + distance, and f = max(e, earliest).
// States are expanded level by level of f; within a level by conflicts, the deepest first. Moves that lead to a later
// level are not generated before that level begins, which on most searches is never.
class SpaceTimeSearch {
public:
    // Returns true if a path exists, which actions() has until the next search; false also if the budget is spent.
    bool run(const Layout& layout, const Traffic& traffic, const Journey& journey, Budget& budget);

    const std::vector<std::uint8_t>& actions() const { return actions_; }
    int conflicts() const { return conflicts_; }

private:
    struct State {
        int cell, time, parent, conflicts;
        std::uint8_t action;
    };
    struct Reached {
        int conflicts = -1;  // the fewest so far, -1 if the state was not reached
    };
    static constexpr int exhausted = std::numeric_limits<int>::max();

    void expand(int id);
    void begin_level();
    void move(int id, int distance_change);
    void pause(int id);
    void step(int id, int action, const Passage& traffic_here);
    void arrive(int id);
    void push(int id, int conflicts);
    int pop();
    void trace(int id);

    const Traffic* traffic_ = nullptr;
    Journey journey_{};
    std::array<int, num_actions> steps_{};
    int level_ = 0;

    std::vector<State> states_;
    PairTable<Reached> reached_;
    std::vector<std::vector<int>> stacks_;  // open states of this level by conflicts; ~id is an arrival
    std::size_t fewest_ = 0;                // no stack below this one holds a state
    std::vector<int> rim_, older_rim_;      // expanded states with e = level, and with e = level - 1
    std::vector<std::uint8_t> actions_;
    int conflicts_ = 0;
};

}  // namespace mapf
