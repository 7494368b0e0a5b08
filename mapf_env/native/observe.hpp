// What robots see: their fields of view.
#pragma once

#include <cstdint>

#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// The channels of the paper: obstacles, the own goal, robots.
inline constexpr int num_channels = 3;

// Channels beyond the paper.
enum class Channel : int { cost_to_go, other_goals, previous_positions };

// Sets the cells of robots or goals (num_agents, 2) in a map of its own.
template <class T>
inline void mark(const Layout& layout, const std::int32_t* cells, int num_agents, T value, T* map) {
    for (int i = 0; i < num_agents; ++i) map[layout.cell(cells[2 * i], cells[2 * i + 1])] = value;
}

// Fields of view of one team, as the paper's released code lays them out: (num_agents, num_planes, side, side) with
// side = 2 * radius + 3, of which the first three planes are written. The inner window is the view; the ring around it
// only carries the goal when that is out of sight. Planes: obstacles (outside the map counts as one), the own goal, all
// robots in view including oneself.
//   obstacles  the map in its layout, as T, which is float or std::uint8_t; layout.pad >= radius
//   marks      layout.size() zeros; zeros again on return
template <class T>
void observe(const Layout& layout, const T* obstacles, const std::int32_t* positions, const std::int32_t* goals,
             int num_agents, int radius, int num_planes, T* marks, T* out);

// Plane: where another robot's goal lies.
template <class T>
void observe_other_goals(const Layout& layout, const std::int32_t* positions, const std::int32_t* goals, int num_agents,
                         int radius, int num_planes, T* marks, T* out);

// Plane: where robots stood one step before.
template <class T>
void observe_previous_positions(const Layout& layout, const std::int32_t* positions, const std::int32_t* previous,
                                int num_agents, int radius, int num_planes, T* marks, T* out);

// Plane: how many steps more than from here the goal is away from each cell in view, within -2 * radius..2 * radius,
// which cells without a way have too. As float that is scaled to -1..1; as an integer it is counted from -2 * radius.
//   distances  (num_agents, layout.size()) steps to each robot's goal
template <class T>
void observe_cost_to_go(const Layout& layout, const Distance* distances, const std::int32_t* positions, int num_agents,
                        int radius, int num_planes, T* out);

}  // namespace mapf
