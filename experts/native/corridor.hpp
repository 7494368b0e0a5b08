// The one proof of infeasibility that is cheap: robots cannot overtake one another in a corridor.
#pragma once

#include <span>

#include "mapf_env/native/grid.hpp"

namespace mapf {

// Returns true if some connected region is a simple path of cells on which the goals are in another order than the
// robots. Exactly on these regions a pair of robots alone has no solution.
bool order_forbids_solution(const Grid& grid, std::span<const int> starts, std::span<const int> goals);

}  // namespace mapf
