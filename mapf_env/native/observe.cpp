#include "mapf_env/native/observe.hpp"

#include <algorithm>
#include <cstdint>
#include <cstdlib>

#include "mapf_env/native/wide.hpp"

namespace mapf {

namespace {

// Returns the index in a plane at which a goal `down` and `right` of the robot is drawn in a view of `radius`: its own
// cell, or if it is out of sight the ring, along the line to it, halves rounded to the even cell.
inline int goal_index(int down, int right, int radius) {
    // In double, a quotient is a half exactly where the true one is, and adding 1.5 * 2^52 rounds halves to even.
    constexpr double rounder = 6755399441055744.0;
    const int edge = radius + 1;
    const bool upright = std::abs(down) > std::abs(right);
    const int longer = upright ? down : right, shorter = upright ? right : down;
    const int reach = std::max(std::abs(longer), edge);
    const int far = std::clamp(longer, -edge, edge);  // the longer way ends on the ring: only the other one is divided
    const int near = static_cast<int>((static_cast<double>(shorter * edge) / reach + rounder) - rounder);
    return ((upright ? far : near) + edge) * (2 * edge + 1) + (upright ? near : far) + edge;
}

template <int fixed_radius, class T>
inline void observe_team(const Layout& layout, const T* obstacles, const std::int32_t* positions,
                         const std::int32_t* goals, int num_agents, int any_radius, int num_planes, T* marks, T* out,
                         const int* order) {
    const int radius = fixed_radius ? fixed_radius : any_radius;
    const int side = 2 * radius + 3, plane = side * side;
    mark(layout, positions, num_agents, T{1}, marks);
    for (int k = 0; k < num_agents; ++k) {
        const int i = order ? order[k] : k, row = positions[2 * i], col = positions[2 * i + 1];
        const int corner = layout.cell(row - radius, col - radius);
        T* const view = out + static_cast<std::size_t>(i) * num_planes * plane;
        copy_window<fixed_radius>(obstacles + corner, layout.stride(), radius, view);
        std::fill_n(view + plane, plane, T{0});
        view[plane + goal_index(goals[2 * i] - row, goals[2 * i + 1] - col, radius)] = T{1};
    }
    // In a pass of its own, which was measured to be faster.
    for (int k = 0; k < num_agents; ++k) {
        const int i = order ? order[k] : k;
        const int corner = layout.cell(positions[2 * i] - radius, positions[2 * i + 1] - radius);
        copy_window<fixed_radius>(marks + corner, layout.stride(), radius,
                                  out + (static_cast<std::size_t>(i) * num_planes + 2) * plane);
    }
    mark(layout, positions, num_agents, T{0}, marks);
}

// Clones for several processors cannot be templates.
#define MAPF_OBSERVE(T)                                                                                             \
    MAPF_WIDE void observe_wide(const Layout& layout, const T* obstacles, const std::int32_t* positions,             \
                                const std::int32_t* goals, int num_agents, int radius, int num_planes, T* marks,     \
                                T* out, const int* order) {                                                         \
        if (radius == 4)                                                                                            \
            observe_team<4>(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out, order);\
        else                                                                                                        \
            observe_team<0>(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out, order);\
    }
MAPF_OBSERVE(float)
MAPF_OBSERVE(std::uint8_t)
#undef MAPF_OBSERVE

}  // namespace

template <class T>
void observe(const Layout& layout, const T* obstacles, const std::int32_t* positions, const std::int32_t* goals,
             int num_agents, int radius, int num_planes, T* marks, T* out, const int* order) {
    observe_wide(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out, order);
}

template void observe(const Layout&, const float*, const std::int32_t*, const std::int32_t*, int, int, int, float*,
                      float*, const int*);
template void observe(const Layout&, const std::uint8_t*, const std::int32_t*, const std::int32_t*, int, int, int,
                      std::uint8_t*, std::uint8_t*, const int*);

}  // namespace mapf
