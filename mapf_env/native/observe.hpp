// The robots' fields of view.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>

#include "mapf_env/native/grid.hpp"

namespace mapf {

// The channels of the paper: obstacles, the own goal, robots.
inline constexpr int num_channels = 3;

// Sets the cells of robots or goals (num_agents, 2) in a map of its own.
template <class T>
inline void mark(const Layout& layout, const std::int32_t* cells, int num_agents, T value, T* map) {
    for (int i = 0; i < num_agents; ++i) map[layout.cell(cells[2 * i], cells[2 * i + 1])] = value;
}

// Writes a plane: the window of a map whose upper left corner is `from`, inside a ring of zeros. `fixed_radius` is the
// radius where the compiler knows it (views of a known size are copied twice as fast), else 0.
template <int fixed_radius, class T>
inline void copy_window(const T* from, int stride, int any_radius, T* out) {
    const int radius = fixed_radius ? fixed_radius : any_radius;
    const int window = 2 * radius + 1, side = window + 2;
    std::fill_n(out, side + 1, T{0});
    out += side + 1;
    for (int row = 0; row < window; ++row, from += stride, out += side) {
        std::memcpy(out, from, (window - 1) * sizeof(T));
        // The last cell, the ring's right end and, in the next row, its left one; as bytes in one piece, whose fourth
        // is written again.
        if constexpr (sizeof(T) == 1 && std::endian::native == std::endian::little) {
            const std::uint32_t end = from[window - 1];
            std::memcpy(out + window - 1, &end, sizeof end);
        } else {
            out[window - 1] = from[window - 1];
            out[window] = out[window + 1] = T{0};
        }
    }
    std::fill_n(out, side - 1, T{0});
}

// Fields of view of one team, as the paper's released code lays them out: (num_agents, num_planes, side, side) with
// side = 2 * radius + 3, of which the first three planes are written. The inner window is the view; the ring around it
// only carries the goal when that is out of sight. Planes: obstacles (outside the map counts as one), the own goal, all
// robots in view including oneself.
//   obstacles  the map in its layout, as T, which is float or std::uint8_t; layout.border >= radius
//   marks      layout.size() zeros; zeros again on return
//   order      the robots in the order in which they are written, as of `order_by_tile`
template <class T>
void observe(const Layout& layout, const T* obstacles, const std::int32_t* positions, const std::int32_t* goals,
             int num_agents, int radius, int num_planes, T* marks, T* out, const int* order = nullptr);

}  // namespace mapf
