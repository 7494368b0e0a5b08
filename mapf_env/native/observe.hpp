// What robots see: their fields of view.
#pragma once

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// The channels of the paper: obstacles, the own goal, robots.
inline constexpr int num_channels = 3;

// Channels beyond the paper.
enum class Channel : int { cost_to_go, other_goals, previous_positions };

// Where a goal `down` and `right` of the robot is drawn in a view of `radius`: in its place, or, if it is out of sight,
// on the ring, along the line to it, halves rounded to the even cell. Returns the index in a plane.
inline int goal_index(int down, int right, int radius) {
    // In double, a quotient is a half exactly where the true one is, and adding 1.5 * 2^52 rounds halves to even.
    constexpr double rounder = 6755399441055744.0;
    const int edge = radius + 1;
    const double reach = std::max(std::max(std::abs(down), std::abs(right)), edge);
    const int row = static_cast<int>((static_cast<double>(down) * edge / reach + rounder) - rounder);
    const int col = static_cast<int>((static_cast<double>(right) * edge / reach + rounder) - rounder);
    return (row + edge) * (2 * edge + 1) + col + edge;
}

// Writes a plane: the window of a map whose upper left corner is `from`, inside a ring of zeros.
template <int fixed_radius, class T>
inline void copy_window(const T* from, int stride, int any_radius, T* out) {
    const int radius = fixed_radius ? fixed_radius : any_radius;
    const int window = 2 * radius + 1, side = window + 2;
    std::fill_n(out, side + 1, T{0});
    out += side + 1;
    for (int row = 0; row < window; ++row, from += stride, out += side) {
        std::memcpy(out, from, window * sizeof(T));
        out[window] = out[window + 1] = T{0};  // the ring's right end and, in the next row, its left one
    }
    std::fill_n(out, side - 1, T{0});
}

// Sets the cells of robots or goals (num_agents, 2) in a map of its own.
template <class T>
inline void mark(const Layout& layout, const std::int32_t* cells, int num_agents, T value, T* map) {
    for (int i = 0; i < num_agents; ++i) map[layout.cell(cells[2 * i], cells[2 * i + 1])] = value;
}

// Fields of view of one team, as the paper's released code lays them out: (num_agents, num_planes, side, side) with
// side = 2 * radius + 3, of which the first three planes are written. The inner window is the view; the ring around it
// only carries the goal when that is out of sight. Planes: obstacles (outside the map counts as one), the own goal, all
// robots in view including oneself.
//   obstacles  the map in its layout, as T; layout.pad >= radius
//   marks      layout.size() zeros; zeros again on return
// `fixed_radius` is the radius where the compiler knows it (views of a known size are copied twice as fast), else 0.
template <int fixed_radius, class T>
void observe_team(const Layout& layout, const T* obstacles, const std::int32_t* positions, const std::int32_t* goals,
                  int num_agents, int any_radius, int num_planes, T* marks, T* out) {
    const int radius = fixed_radius ? fixed_radius : any_radius;
    const int side = 2 * radius + 3, plane = side * side;
    mark(layout, positions, num_agents, T{1}, marks);
    for (int i = 0; i < num_agents; ++i, out += num_planes * plane) {
        const int row = positions[2 * i], col = positions[2 * i + 1];
        const int corner = layout.cell(row - radius, col - radius);
        copy_window<fixed_radius>(obstacles + corner, layout.stride(), radius, out);
        std::fill_n(out + plane, plane, T{0});
        out[plane + goal_index(goals[2 * i] - row, goals[2 * i + 1] - col, radius)] = T{1};
        copy_window<fixed_radius>(marks + corner, layout.stride(), radius, out + 2 * plane);
    }
    mark(layout, positions, num_agents, T{0}, marks);
}

template <class T>
void observe(const Layout& layout, const T* obstacles, const std::int32_t* positions, const std::int32_t* goals,
             int num_agents, int radius, int num_planes, T* marks, T* out) {
    const auto team = radius == 4 ? observe_team<4, T> : observe_team<0, T>;
    team(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out);
}

// Plane: where another robot's goal lies.
template <class T>
void observe_other_goals(const Layout& layout, const std::int32_t* positions, const std::int32_t* goals, int num_agents,
                         int radius, int num_planes, T* marks, T* out) {
    const int side = 2 * radius + 3;
    mark(layout, goals, num_agents, T{1}, marks);
    for (int i = 0; i < num_agents; ++i, out += num_planes * side * side) {
        T& own = marks[layout.cell(goals[2 * i], goals[2 * i + 1])];
        own = T{0};
        const int corner = layout.cell(positions[2 * i] - radius, positions[2 * i + 1] - radius);
        copy_window<0>(marks + corner, layout.stride(), radius, out);
        own = T{1};
    }
    mark(layout, goals, num_agents, T{0}, marks);
}

// Plane: where robots stood one step before.
template <class T>
void observe_previous_positions(const Layout& layout, const std::int32_t* positions, const std::int32_t* previous,
                                int num_agents, int radius, int num_planes, T* marks, T* out) {
    const int side = 2 * radius + 3;
    mark(layout, previous, num_agents, T{1}, marks);
    for (int i = 0; i < num_agents; ++i, out += num_planes * side * side) {
        const int corner = layout.cell(positions[2 * i] - radius, positions[2 * i + 1] - radius);
        copy_window<0>(marks + corner, layout.stride(), radius, out);
    }
    mark(layout, previous, num_agents, T{0}, marks);
}

// Plane: how many steps more than from here the goal is away from each cell in view, within -2 * radius..2 * radius,
// which cells without a way have too. As float that is scaled to -1..1; as an integer it is counted from -2 * radius.
//   distances  (num_agents, layout.size()) steps to each robot's goal
template <class T>
void observe_cost_to_go(const Layout& layout, const Distance* distances, const std::int32_t* positions, int num_agents,
                        int radius, int num_planes, T* out) {
    const int side = 2 * radius + 3, plane = side * side, reach = 2 * radius, stride = layout.stride();
    for (int i = 0; i < num_agents; ++i, out += num_planes * plane, distances += layout.size()) {
        const int cell = layout.cell(positions[2 * i], positions[2 * i + 1]);
        const int here = distances[cell];
        std::fill_n(out, plane, T{0});
        for (int down = -radius; down <= radius; ++down)
            for (int right = -radius; right <= radius; ++right) {
                const int there = distances[cell + down * stride + right];
                const int more = there == unreachable ? reach : std::clamp(there - here, -reach, reach);
                T& value = out[(down + radius + 1) * side + right + radius + 1];
                if constexpr (std::is_same_v<T, float>)
                    value = static_cast<float>(more) / static_cast<float>(reach);
                else
                    value = static_cast<T>(more + reach);
            }
    }
}

}  // namespace mapf
