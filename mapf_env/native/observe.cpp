#include "mapf_env/native/observe.hpp"

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <type_traits>

#include "mapf_env/native/wide.hpp"

namespace mapf {

namespace {

// Where a goal `down` and `right` of the robot is drawn in a view of `radius`: in its place, or, if it is out of sight,
// on the ring, along the line to it, halves rounded to the even cell. Returns the index in a plane.
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

template <int fixed_radius, class T>
inline void observe_team(const Layout& layout, const T* obstacles, const std::int32_t* positions,
                         const std::int32_t* goals, int num_agents, int any_radius, int num_planes, T* marks, T* out) {
    const int radius = fixed_radius ? fixed_radius : any_radius;
    const int side = 2 * radius + 3, plane = side * side;
    mark(layout, positions, num_agents, T{1}, marks);
    T* const first = out;
    for (int i = 0; i < num_agents; ++i, out += num_planes * plane) {
        const int row = positions[2 * i], col = positions[2 * i + 1];
        const int corner = layout.cell(row - radius, col - radius);
        copy_window<fixed_radius>(obstacles + corner, layout.stride(), radius, out);
        std::fill_n(out + plane, plane, T{0});
        out[plane + goal_index(goals[2 * i] - row, goals[2 * i + 1] - col, radius)] = T{1};
    }
    // In a pass of its own, which was measured to be faster.
    out = first;
    for (int i = 0; i < num_agents; ++i, out += num_planes * plane) {
        const int corner = layout.cell(positions[2 * i] - radius, positions[2 * i + 1] - radius);
        copy_window<fixed_radius>(marks + corner, layout.stride(), radius, out + 2 * plane);
    }
    mark(layout, positions, num_agents, T{0}, marks);
}

// Clones for several processors cannot be templates.
#define MAPF_OBSERVE(T)                                                                                             \
    MAPF_WIDE void observe_wide(const Layout& layout, const T* obstacles, const std::int32_t* positions,             \
                                const std::int32_t* goals, int num_agents, int radius, int num_planes, T* marks,     \
                                T* out) {                                                                           \
        if (radius == 4)                                                                                            \
            observe_team<4>(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out);       \
        else                                                                                                        \
            observe_team<0>(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out);       \
    }
MAPF_OBSERVE(float)
MAPF_OBSERVE(std::uint8_t)
#undef MAPF_OBSERVE

}  // namespace

template <class T>
void observe(const Layout& layout, const T* obstacles, const std::int32_t* positions, const std::int32_t* goals,
             int num_agents, int radius, int num_planes, T* marks, T* out) {
    observe_wide(layout, obstacles, positions, goals, num_agents, radius, num_planes, marks, out);
}

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

#define MAPF_FOR(T)                                                                                                   \
    template void observe(const Layout&, const T*, const std::int32_t*, const std::int32_t*, int, int, int, T*, T*);  \
    template void observe_other_goals(const Layout&, const std::int32_t*, const std::int32_t*, int, int, int, T*, T*); \
    template void observe_previous_positions(const Layout&, const std::int32_t*, const std::int32_t*, int, int, int,  \
                                             T*, T*);                                                                 \
    template void observe_cost_to_go(const Layout&, const Distance*, const std::int32_t*, int, int, int, T*);
MAPF_FOR(float)
MAPF_FOR(std::uint8_t)
#undef MAPF_FOR

}  // namespace mapf
