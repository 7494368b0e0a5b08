#include "mapf_env/native/generate.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>
#include <string>

namespace mapf {

namespace {

// Turns free cells into obstacles, one at a time, and only where the other free cells stay connected.
class MapBuilder {
public:
    MapBuilder(int height, int width)
        : grid_(std::vector<std::uint8_t>(static_cast<std::size_t>(height) * width).data(), height, width),
          steps_(grid_.layout.steps()), seen_(grid_.blocked.size(), 0), free_(height * width) {}

    const Layout& layout() const { return grid_.layout; }
    bool blocked(int cell) const { return grid_.blocked[cell] != 0; }
    int obstacles() const { return layout().height * layout().width - free_; }
    Grid finish() && { return std::move(grid_); }

    bool try_block(int cell) {
        if (blocked(cell) || free_ == 1) return false;
        grid_.blocked[cell] = 1;
        if (!neighbours_connected(cell)) {
            grid_.blocked[cell] = 0;
            return false;
        }
        --free_;
        return true;
    }

private:
    // Returns true if the free neighbours of the newly blocked `cell` still reach each other.
    bool neighbours_connected(int cell) {
        const int stride = layout().stride();
        const std::array<int, 8> ring{-stride, -stride + 1, 1, stride + 1, stride, stride - 1, -1, -stride - 1};
        int gaps = 0;  // free sides (even places of the ring) that are cut off from the side before them
        for (int side = 0; side < 8; side += 2) {
            const bool corner_free = !blocked(cell + ring[(side + 7) % 8]);
            const bool before_free = !blocked(cell + ring[(side + 6) % 8]);
            if (!blocked(cell + ring[side]) && !(corner_free && before_free)) ++gaps;
        }
        return gaps <= 1 || floods_meet(cell);
    }

    // Floods from all free neighbours in turns until the floods have met or one of them is full: the cost is that of
    // the smallest way round or pocket, not of the map.
    bool floods_meet(int cell) {
        std::array<std::size_t, idle> head{};
        std::array<int, idle> group{0, 1, 2, 3};  // floods that have met share their group
        int groups = 0;
        mark_ += idle;
        for (int flood = 0; flood < idle; ++flood) {
            queue_[flood].clear();
            const int neighbour = cell + steps_[flood];
            if (blocked(neighbour)) continue;
            seen_[neighbour] = mark_ + flood;
            queue_[flood].push_back(neighbour);
            ++groups;
        }
        while (groups > 1)
            for (int flood = 0; flood < idle && groups > 1; ++flood) {
                if (queue_[flood].empty()) continue;
                if (head[flood] == queue_[flood].size()) {
                    bool group_full = true;
                    for (int other = 0; other < idle; ++other)
                        group_full &= group[other] != group[flood] || head[other] == queue_[other].size();
                    if (group_full) return false;
                    continue;
                }
                const int here = queue_[flood][head[flood]++];
                for (int action = 0; action < idle; ++action) {
                    const int next = here + steps_[action];
                    if (blocked(next)) continue;
                    if (seen_[next] < mark_) {
                        seen_[next] = mark_ + flood;
                        queue_[flood].push_back(next);
                    } else if (const int met = group[seen_[next] - mark_]; met != group[flood]) {
                        std::replace(group.begin(), group.end(), met, group[flood]);
                        --groups;
                    }
                }
            }
        return true;
    }

    Grid grid_;
    std::array<int, num_actions> steps_;
    std::vector<int> seen_;  // mark_ + the flood that reached the cell; smaller values are of earlier floods
    std::array<std::vector<int>, idle> queue_;
    int mark_ = 0;
    int free_;
};

void add_cells(MapBuilder& map, int obstacles, Random& random) {
    const auto& layout = map.layout();
    std::vector<int> cells;
    for (int row = 0; row < layout.height; ++row)
        for (int col = 0; col < layout.width; ++col) cells.push_back(layout.cell(row, col));
    // Drawn as they are needed: most maps have few obstacles.
    const int count = static_cast<int>(cells.size());
    for (int i = 0; i < count && map.obstacles() < obstacles; ++i) {
        std::swap(cells[i], cells[i + random.below(count - i)]);
        map.try_block(cells[i]);
    }
    // A cell that would cut the map may become removable once its surroundings are full: go round again. Some free
    // cell can always be blocked without a cut, so every round makes progress.
    while (map.obstacles() < obstacles)
        for (const int cell : cells)
            if (map.obstacles() < obstacles) map.try_block(cell);
}

// Returns whether there was room: walls that happen to stand badly leave none for others.
bool add_walls(MapBuilder& map, const Parts& parts, int obstacles, Random& random) {
    const long straight_of_thousand = std::lround(1000 * parts.straight);
    const auto& layout = map.layout();
    // Pillars stand on every second row and column, from the first one or inside a free border.
    const int first = parts.ring ? 1 : 0;
    const int pillar_rows = (layout.height + 1) / 2 - first, pillar_cols = (layout.width + 1) / 2 - first;
    if (pillar_rows == 0 || pillar_cols == 0) return obstacles == 0;
    const auto is_pillar = [&](int row, int col) {
        return row >= first && row < layout.height - first && col >= first && col < layout.width - first;
    };
    const int patience = 16 * pillar_rows * pillar_cols;
    int fruitless = 0;
    while (map.obstacles() < obstacles) {
        const int before = map.obstacles();
        int row = first + 2 * random.below(pillar_rows), col = first + 2 * random.below(pillar_cols), direction = 0;
        map.try_block(layout.cell(row, col));
        for (int segment = 0; segment < parts.segments; ++segment) {
            const bool turns = segment == 0 || straight_of_thousand == 0 || random.below(1000) >= straight_of_thousand;
            if (turns) direction = random.below(idle);
            const int next_row = row + 2 * row_step[direction], next_col = col + 2 * col_step[direction];
            if (!is_pillar(next_row, next_col) || map.blocked(layout.cell(next_row, next_col))) continue;
            const int link = layout.cell(row + row_step[direction], col + col_step[direction]);
            if (map.obstacles() < obstacles) map.try_block(link);
            if (map.obstacles() < obstacles) map.try_block(layout.cell(next_row, next_col));
            row = next_row;
            col = next_col;
        }
        fruitless = map.obstacles() == before ? fruitless + 1 : 0;
        if (fruitless > patience) return false;
    }
    return true;
}

MapBuilder map_of_walls(int height, int width, const Parts& parts, int obstacles, Random& random) {
    constexpr int attempts = 20;
    int most = 0;
    for (int attempt = 0; attempt < attempts; ++attempt) {
        MapBuilder map(height, width);
        if (add_walls(map, parts, obstacles, random)) return map;
        most = std::max(most, map.obstacles());
    }
    throw std::invalid_argument("walls fill at most about " + std::to_string(most) + " of the " +
                                std::to_string(height * width) + " cells here, not " + std::to_string(obstacles) +
                                ": lower the density or use the style \"cells\"");
}

// Maps drawn on a sheet of height * width cells, row-major; 1 is an obstacle.
struct Sheet {
    int height, width;
    std::vector<std::uint8_t> cells;

    Sheet(int height, int width, std::uint8_t fill)
        : height(height), width(width), cells(static_cast<std::size_t>(height) * width, fill) {}

    std::uint8_t& at(int row, int col) { return cells[static_cast<std::size_t>(row) * width + col]; }
};

// A spanning tree of the cells with even coordinates, drawn by a random walk that backtracks; a share of the other links
// is opened too, so that there are ways round.
void carve_maze(Sheet& sheet, double loops, Random& random) {
    const long closed_of_thousand = 1000 - std::lround(1000 * loops);
    const auto inside = [&](int row, int col) {
        return row >= 0 && row < sheet.height && col >= 0 && col < sheet.width;
    };
    std::vector<std::pair<int, int>> trail{{0, 0}};
    sheet.at(0, 0) = 0;
    while (!trail.empty()) {
        const auto [row, col] = trail.back();
        std::array<int, idle> ways{};
        int count = 0;
        for (int action = 0; action < idle; ++action) {
            const int next_row = row + 2 * row_step[action], next_col = col + 2 * col_step[action];
            if (inside(next_row, next_col) && sheet.at(next_row, next_col)) ways[count++] = action;
        }
        if (count == 0) {
            trail.pop_back();
            continue;
        }
        const int action = ways[random.below(count)];
        sheet.at(row + row_step[action], col + col_step[action]) = 0;
        trail.emplace_back(row + 2 * row_step[action], col + 2 * col_step[action]);
        sheet.at(trail.back().first, trail.back().second) = 0;
    }
    for (int row = 0; row < sheet.height; ++row)
        for (int col = (row + 1) % 2; col < sheet.width; col += 2) {
            const bool links = row % 2 ? row + 1 < sheet.height : col + 1 < sheet.width;
            if (links && sheet.at(row, col) && random.below(1000) >= closed_of_thousand) sheet.at(row, col) = 0;
        }
}

// A maze whose corridors are `corridor_width` cells wide, narrower at the lower and right edge, between walls one cell
// thick.
void build_maze(Sheet& sheet, const Parts& parts, Random& random) {
    const int period = parts.corridor_width + 1;
    Sheet plan(2 * ((sheet.height - 1) / period) + 1, 2 * ((sheet.width - 1) / period) + 1, 1);
    carve_maze(plan, parts.loops, random);
    const auto planned = [&](int place) { return 2 * (place / period) + (place % period == parts.corridor_width); };
    for (int row = 0; row < sheet.height; ++row)
        for (int col = 0; col < sheet.width; ++col) {
            const int from_row = planned(row), from_col = planned(col);
            const bool inside = from_row < plan.height && from_col < plan.width;
            sheet.at(row, col) = inside ? plan.at(from_row, from_col) : 1;
        }
}

// Square rooms, smaller at the lower and right edge, between walls one cell thick.
void build_rooms(Sheet& sheet, const Parts& parts, Random& random) {
    const int side = parts.room_size, period = side + 1;
    const auto is_wall = [&](int place, int extent) { return place % period == side && place + 1 < extent; };
    for (int row = 0; row < sheet.height; ++row)
        for (int col = 0; col < sheet.width; ++col)
            sheet.at(row, col) = is_wall(row, sheet.height) || is_wall(col, sheet.width);
    const auto door = [&](int first, int extent) {  // somewhere along the wall of a room that begins at `first`
        int length = std::min(side, extent - first);
        if (first + length + 1 == extent && length == side) ++length;  // a wall at the edge would part nothing
        return first + random.below(length);
    };
    for (int row = 0; row < sheet.height; row += period)
        for (int col = side; is_wall(col, sheet.width); col += period) sheet.at(door(row, sheet.height), col) = 0;
    for (int col = 0; col < sheet.width; col += period)
        for (int row = side; is_wall(row, sheet.height); row += period) sheet.at(row, door(col, sheet.width)) = 0;
}

// Shelves along the rows, in a margin as wide as a corridor above and below and as two at the sides.
void place_shelves(Sheet& sheet, const Parts& parts) {
    const int aisle = parts.corridor_width, depth = parts.shelf_depth, length = parts.shelf_length;
    for (int row = aisle; row < sheet.height - aisle; ++row)
        for (int col = 2 * aisle; col < sheet.width - 2 * aisle; ++col)
            sheet.at(row, col) =
                (row - aisle) % (depth + aisle) < depth && (col - 2 * aisle) % (length + aisle) < length;
}

}  // namespace

Grid random_map(Style style, const Parts& parts, int height, int width, int obstacles, Random& random) {
    if (style == Style::cells || style == Style::walls) {
        if (obstacles >= height * width)
            throw std::invalid_argument(std::to_string(obstacles) + " obstacles leave no free cell on a " +
                                        std::to_string(height) + "x" + std::to_string(width) +
                                        " map: lower the density");
        if (style == Style::walls) return map_of_walls(height, width, parts, obstacles, random).finish();
        MapBuilder map(height, width);
        add_cells(map, obstacles, random);
        return std::move(map).finish();
    }
    Sheet sheet(height, width, 0);
    if (style == Style::maze) build_maze(sheet, parts, random);
    if (style == Style::room) build_rooms(sheet, parts, random);
    if (style == Style::warehouse) place_shelves(sheet, parts);
    return {sheet.cells.data(), height, width};
}

void place_agents(const Grid& grid, int num_agents, Random& random, std::int32_t* starts, std::int32_t* goals) {
    const auto& layout = grid.layout;
    const auto regions = regions_of(grid);
    std::vector<int> region_size(regions.size(), 0);
    for (const auto region : regions)
        if (region >= 0) ++region_size[region];
    const auto largest = std::max_element(region_size.begin(), region_size.end()) - region_size.begin();
    std::vector<int> cells;
    for (int row = 0; row < layout.height; ++row)
        for (int col = 0; col < layout.width; ++col)
            if (regions[layout.cell(row, col)] == largest) cells.push_back(row * layout.width + col);
    if (static_cast<int>(cells.size()) < std::max(num_agents, 2))
        throw std::invalid_argument("the largest connected free region has " + std::to_string(cells.size()) +
                                    " cells, too few for " + std::to_string(num_agents) +
                                    " agents with goals of their own: ask for fewer agents or a lower density");
    const auto write = [&](const std::vector<int>& chosen, std::int32_t* out) {
        for (int i = 0; i < num_agents; ++i) {
            *out++ = chosen[i] / layout.width;
            *out++ = chosen[i] % layout.width;
        }
    };
    std::vector<int> ends = cells;
    random.shuffle_front(cells, num_agents);
    random.shuffle_front(ends, num_agents);
    // Exchanging a robot's own start for any other entry never makes a new robot sit on its goal.
    for (int i = 0; i < num_agents; ++i)
        if (ends[i] == cells[i]) {
            const int other = random.below(static_cast<int>(ends.size()) - 1);
            std::swap(ends[i], ends[other + (other >= i)]);
        }
    write(cells, starts);
    write(ends, goals);
}

}  // namespace mapf
