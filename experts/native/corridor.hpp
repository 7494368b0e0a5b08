// The one proof of infeasibility that is cheap: robots cannot overtake one another in a corridor.
#pragma once

#include <span>

#include "mapf_env/native/grid.hpp"

namespace mapf {

// Whether some connected region is a simple path of cells on which the order of the robots' goals is not the order of
// the robots. Exactly these are the regions on which a pair of robots alone is without a solution.
bool order_forbids_solution(const Grid& grid, std::span<const int> starts, std::span<const int> goals);

}  // namespace mapf
