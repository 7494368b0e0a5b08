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

// B joint states, R robots in all; state b is one of problem problem_of[b] and has that problem's number of robots.
struct States {
    std::size_t count;
    const std::int32_t* positions;  // (R, 2) row and column
    const std::int64_t* offsets;    // (B + 1) into the robots
    const std::int64_t* problem_of;

    std::size_t num_robots(std::size_t state) const {
        return static_cast<std::size_t>(offsets[state + 1] - offsets[state]);
    }
};

// Writes `actions` (R) and whether each state was `solved` (B); the actions of an unsolved state are all idle.
// Throws std::invalid_argument where a state is none of its problem: a robot off the map, on an obstacle, in another
// robot's cell or cut off from its goal.
void relabel(const std::vector<GoalsOnGrid>& problems, const States& states, const EcbsOptions& options, int threads,
             Interrupt& interrupt, std::int8_t* actions, bool* solved);

}  // namespace mapf
