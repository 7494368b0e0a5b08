// The grid as every solver and rule sees it: cells in one row-major array with a border of obstacles, so that a
// neighbour is an addition and needs no bounds check.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace mapf {

inline constexpr int num_actions = 5;
inline constexpr int idle = 4;

// The moves in the paper's order: up, left, down, right, idle.
inline constexpr std::array<int, num_actions> row_step{-1, 0, 1, 0, 0};
inline constexpr std::array<int, num_actions> col_step{0, -1, 0, 1, 0};

// Geometry of a height x width map inside a border of `border` obstacle cells.
struct Layout {
    int height, width, border;

    int stride() const { return width + 2 * border; }
    int rows() const { return height + 2 * border; }
    int size() const { return rows() * stride(); }
    int cell(int row, int col) const { return (row + border) * stride() + col + border; }
    int row(int cell) const { return cell / stride() - border; }
    int col(int cell) const { return cell % stride() - border; }
    bool contains(int row, int col) const { return row >= 0 && row < height && col >= 0 && col < width; }
    std::array<int, num_actions> steps() const { return {-stride(), -1, stride(), 1, 0}; }
};

// Obstacles of one map inside a border, one cell wide or as wide as a kernel needs.
struct Grid {
    Layout layout;
    std::vector<std::uint8_t> blocked;  // 1 or 0

    // Takes over a map that has its border.
    Grid(const Layout& layout, std::vector<std::uint8_t> blocked) : layout(layout), blocked(std::move(blocked)) {}

    // `obstacles` holds height * width values, row-major; non-zero is an obstacle.
    Grid(const std::uint8_t* obstacles, int height, int width) : layout{height, width, 1} {
        blocked.assign(static_cast<std::size_t>(layout.size()), 1);
        for (int row = 0; row < height; ++row)
            for (int col = 0; col < width; ++col)
                blocked[layout.cell(row, col)] = obstacles[static_cast<std::size_t>(row) * width + col] != 0;
    }
};

// Below so many robots a team and what lies around it fit into a processor's cache, whatever the order.
inline constexpr int large_team = 4096;

// The robots (N, 2) of a large team tile by tile of the map, so that what is read around one of them is still in the cache
// for the next. Returns nullptr for other teams, whose order is that of their numbers. `order` and `ends` are scratch.
inline const int* order_by_tile(const Layout& layout, const std::int32_t* positions, int num_agents,
                                std::vector<int>& order, std::vector<int>& ends) {
    constexpr int tile_rows = 16, tile_cols = 64;
    if (num_agents < large_team) return nullptr;
    const int tiles_in_row = layout.width / tile_cols + 1;
    const auto tile = [&](int i) { return positions[2 * i] / tile_rows * tiles_in_row + positions[2 * i + 1] / tile_cols; };
    order.resize(num_agents);
    ends.assign(static_cast<std::size_t>(layout.height / tile_rows + 1) * tiles_in_row + 1, 0);
    for (int i = 0; i < num_agents; ++i) ++ends[tile(i) + 1];
    for (std::size_t t = 1; t < ends.size(); ++t) ends[t] += ends[t - 1];
    for (int i = 0; i < num_agents; ++i) order[ends[tile(i)]++] = i;
    return order.data();
}

// The region of each cell (layout.size()), numbered 0, 1, ... row by row; -1 on obstacles and the border.
inline std::vector<std::int32_t> regions_of(const Grid& grid) {
    const auto& layout = grid.layout;
    const auto steps = layout.steps();
    std::vector<std::int32_t> region(grid.blocked.size(), -1);
    std::vector<int> stack;
    std::int32_t count = 0;
    for (int row = 0; row < layout.height; ++row)
        for (int col = 0; col < layout.width; ++col) {
            const int cell = layout.cell(row, col);
            if (grid.blocked[cell] || region[cell] >= 0) continue;
            region[cell] = count;
            stack.push_back(cell);
            while (!stack.empty()) {
                const int here = stack.back();
                stack.pop_back();
                for (int action = 0; action < idle; ++action) {
                    const int neighbour = here + steps[action];
                    if (grid.blocked[neighbour] || region[neighbour] >= 0) continue;
                    region[neighbour] = count;
                    stack.push_back(neighbour);
                }
            }
            ++count;
        }
    return region;
}

}  // namespace mapf
