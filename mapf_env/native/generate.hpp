// Random maps and random placements of robots.
#pragma once

#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

enum class Style {
    cells,  // obstacles are independent cells
    walls,  // walls that grow between cells with even coordinates, as in the paper's released generator
    maze,       // corridors
    room,       // square rooms with a door between any two neighbours
    warehouse,  // shelves
    empty,      // no obstacles
};

// The sizes, in cells and at least 1, of what such maps are made of; each style has its own.
struct Parts {
    int corridor_width = 1;  // of mazes and warehouses
    double loops = 0.1;      // share of a maze's walls between two corridors that is opened, beyond what connects it
    int room_size = 5;
    int shelf_length = 10, shelf_depth = 2;
    int segments = 2;       // steps of two cells that a wall grows
    double straight = 0.0;  // share of these steps that keep the direction of the step before
    bool ring = false;      // walls leave the map's border free
};

// A map whose free cells are connected; of the styles cells and walls with exactly `obstacles` obstacles.
// Throws std::invalid_argument if the style cannot place that many; it never runs on without end.
Grid random_map(Style style, const Parts& parts, int height, int width, int obstacles, Random& random);

// Distinct starts and distinct goals, uniform over the largest connected free region, no robot on its own goal.
// Writes (num_agents, 2) rows and columns each. Throws std::invalid_argument if the region is too small.
void place_agents(const Grid& grid, int num_agents, Random& random, std::int32_t* starts, std::int32_t* goals);

}  // namespace mapf
