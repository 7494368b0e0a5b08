// DAgger's seam: the expert's next joint action in many states, with distance tables shared by the states of a problem.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/ecbs.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

struct GoalsOnGrid {
    Grid grid;
    std::vector<int> goals;
};

// B joint states of N robots; state b is one of problem problem_of[b].
struct States {
    std::size_t count, num_robots;
    const std::int32_t* positions;  // (B, N, 2) row and column
    const std::int64_t* problem_of;
};

// Writes `actions` (B, N) and whether each state was `solved` (B); the actions of an unsolved state are all idle.
// Throws std::invalid_argument where a state is none of its problem: a robot off the map, on an obstacle, in another
// robot's cell or cut off from its goal.
void relabel(const std::vector<GoalsOnGrid>& problems, const States& states, const EcbsOptions& options, int threads,
             Interrupt& interrupt, std::int8_t* actions, bool* solved);

}  // namespace mapf
