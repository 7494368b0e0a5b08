#include "experts/native/corridor.hpp"

#include <cstdint>
#include <vector>

namespace mapf {

namespace {

int degree(const Grid& grid, int cell) {
    int neighbours = 0;
    const auto steps = grid.layout.steps();
    for (int action = 0; action < idle; ++action) neighbours += !grid.blocked[cell + steps[action]];
    return neighbours;
}

// The cells of the region of `cell`, marked as `seen`; in the order of the search, so along a path from its end.
void collect(const Grid& grid, int cell, std::vector<std::uint8_t>& seen, std::vector<int>& region) {
    const auto steps = grid.layout.steps();
    region.assign(1, cell);
    seen[cell] = 1;
    for (std::size_t next = 0; next < region.size(); ++next)
        for (int action = 0; action < idle; ++action) {
            const int neighbour = region[next] + steps[action];
            if (grid.blocked[neighbour] || seen[neighbour]) continue;
            seen[neighbour] = 1;
            region.push_back(neighbour);
        }
}

}  // namespace

bool order_forbids_solution(const Grid& grid, std::span<const int> starts, std::span<const int> goals) {
    constexpr int nobody = -1;
    std::vector<std::uint8_t> seen(grid.blocked.size(), 0);
    std::vector<int> robot_at(grid.blocked.size(), nobody), rank(grid.blocked.size(), 0), region;
    for (std::size_t robot = 0; robot < starts.size(); ++robot) robot_at[starts[robot]] = static_cast<int>(robot);
    for (const int start : starts) {
        if (seen[start]) continue;
        collect(grid, start, seen, region);
        int end = nobody, widest = 0;
        for (const int cell : region) {
            const int neighbours = degree(grid, cell);
            if (neighbours <= 1) end = cell;
            if (neighbours > widest) widest = neighbours;
        }
        if (end == nobody || widest > 2) continue;
        for (const int cell : region) seen[cell] = 0;
        collect(grid, end, seen, region);
        for (std::size_t i = 0; i < region.size(); ++i) rank[region[i]] = static_cast<int>(i);
        int furthest = -1;
        for (const int cell : region) {
            if (robot_at[cell] == nobody) continue;
            const int goal = rank[goals[robot_at[cell]]];
            if (goal < furthest) return true;
            furthest = goal;
        }
    }
    return false;
}

}  // namespace mapf
