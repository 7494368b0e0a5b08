// A planner for teams whose goals keep changing: plans a few steps ahead, again and again.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <unordered_map>
#include <vector>

#include "experts/native/budget.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/pibt_step.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

// Rolling-horizon collision resolution (Li, Tinka, Kiesel, Durham, Kumar and Koenig 2021, "Lifelong multi-agent path
// finding in large-scale warehouses"): joint plans of a fixed number of steps, the window, without a conflict in it.
// Here PIBT with swap makes the first plan, so there always is one, and large neighbourhood search improves it (Jiang,
// Zhang, Veerapaneni and Li 2024, "Scaling lifelong multi-agent path finding to more realistic settings").
//
// A robot costs the time until it first comes to its goal; where that is not in the window, the window and the distance
// that is left. After that it has no goal, and only keeps out of the others' way.
class RollingHorizon {
public:
    RollingHorizon(Grid grid, int window, int rounds, std::uint64_t seed);

    // Plans from `cells` (N, distinct) to `goals` (N), which must be in reach. Begins with what is left of the last plan
    // if the robots stand where that left them after `executed` steps. Where the budget is spent, the plan is improved less.
    void plan(std::span<const int> cells, std::span<const int> goals, int executed, Budget& budget);

    const Grid& grid() const { return grid_; }
    int window() const { return window_; }
    int action(std::size_t robot, int time) const { return actions_[robot * static_cast<std::size_t>(window_) + time]; }

    // False if the goal cannot be reached from the cell. Finds the goal's distances.
    bool reaches(int cell, int goal);

private:
    struct State {
        int cell, parent;
        int arrival;  // forever, before the robot has arrived
        std::uint8_t action;
    };

    bool keep_last_plan(std::span<const int> cells, int executed);
    void roll_out(int from);
    std::int64_t assess();
    int cost_of(int robot) const;
    void improve(Budget& budget);
    void choose(int first, std::size_t size);
    void replan();
    bool search(int robot, int latest);
    void enter(int robot);
    void leave(int robot);
    int& occupant(int time, int cell) { return occupants_[static_cast<std::size_t>(time) * grid_.blocked.size() + cell]; }
    std::uint8_t* actions_of(int robot) { return &actions_[static_cast<std::size_t>(robot) * window_]; }
    const std::uint8_t* actions_of(int robot) const { return &actions_[static_cast<std::size_t>(robot) * window_]; }
    int distance(int robot) const { return table_of_[robot][cells_[robot]]; }

    Grid grid_;
    int window_, rounds_;
    std::array<int, num_actions> steps_;
    Random random_;
    PibtStep<> pibt_;
    std::unordered_map<int, std::vector<Distance>> tables_;  // by goal
    std::vector<int> queue_;
    std::vector<const Distance*> table_of_;  // of each robot
    std::vector<int> cells_, goals_, under_way_;
    std::vector<std::uint8_t> actions_, old_actions_;  // (N, window)
    std::vector<int> costs_;
    std::vector<int> occupants_;  // (window + 1, cells), nobody is -1
    std::vector<int> order_, chosen_;
    std::vector<std::uint8_t> is_chosen_, preferences_, step_actions_;
    std::vector<int> step_cells_;
    std::vector<std::vector<State>> layers_;      // by time
    std::vector<std::array<int, 2>> reached_;     // by cell: its state in the layer under way, before and after arrival
    std::vector<int> touched_;
};

}  // namespace mapf
