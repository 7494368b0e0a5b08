// Random maps and random placements of robots.
#pragma once

#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

enum class Style {
    cells,  // obstacles are independent cells
    walls,  // obstacles are short walls between cells with even coordinates, as in the paper's released generator
    maze,       // corridors one cell wide
    room,       // square rooms with a door between any two neighbours
    warehouse,  // shelves with aisles one cell wide
    empty,      // no obstacles
};

// A map whose free cells are connected; of the styles cells and walls with exactly `obstacles` obstacles.
// Throws std::invalid_argument if the style cannot place that many; it never runs on without end.
Grid random_map(Style style, int height, int width, int obstacles, Random& random);

// Distinct starts and distinct goals, uniform over the largest connected free region, no robot on its own goal.
// Writes (num_agents, 2) rows and columns each. Throws std::invalid_argument if the region is too small.
void place_agents(const Grid& grid, int num_agents, Random& random, std::int32_t* starts, std::int32_t* goals);

}  // namespace mapf
