// Steps to the goals of many robots on large maps: each robot has a table of the cells around it, which a search backwards
// from its goal fills, and the search goes only as far as that takes.
#pragma once

#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

template <class T>
Grid grid_of(const Layout& layout, const T* obstacles) {
    std::vector<std::uint8_t> blocked(layout.size());
    std::transform(obstacles, obstacles + layout.size(), blocked.begin(), [](T cell) { return cell != T{0}; });
    return {layout, std::move(blocked)};
}

// The size of each robot's table, in cells of the bordered map. A table as large as the map never has to be filled again.
struct TableShape {
    int rows = 0, cols = 0;

    std::size_t size() const { return static_cast<std::size_t>(rows) * cols; }
    bool is_whole(const Layout& layout) const { return rows == layout.rows() && cols == layout.stride(); }
};

// The upper left cell of the table of a robot at (row, col), counted in the bordered map.
inline void place_table(const Layout& layout, TableShape shape, int row, int col, std::int32_t* corner) {
    corner[0] = std::clamp(row + layout.border - shape.rows / 2, 0, layout.rows() - shape.rows);
    corner[1] = std::clamp(col + layout.border - shape.cols / 2, 0, layout.stride() - shape.cols);
}

// The tables of N robots.
struct WayTables {
    const Distance* steps = nullptr;        // (N, rows, cols)
    const std::int32_t* corners = nullptr;  // (N, 2) as of `place_table`
    TableShape shape{};

    // The entry of a cell that the robot's table covers; neighbours are 1 and shape.cols entries away.
    const Distance* at(const Layout& layout, int robot, int row, int col) const {
        const std::int32_t* corner = corners + 2 * robot;
        return steps + robot * shape.size() + static_cast<std::size_t>(row + layout.border - corner[0]) * shape.cols +
               (col + layout.border - corner[1]);
    }

    // Returns true if the table covers all cells at most `radius` rows and columns away.
    bool covers(const Layout& layout, int robot, int row, int col, int radius) const {
        const int top = row + layout.border - corners[2 * robot], left = col + layout.border - corners[2 * robot + 1];
        return top >= radius && left >= radius && top + radius < shape.rows && left + radius < shape.cols;
    }
};

// A breadth-first search backwards from one goal that goes on where it stopped.
template <class T>
class GoalSearch {
public:
    // Takes another map; nothing is done until the first search.
    void on(const Layout& layout, const T* obstacles) {
        layout_ = layout;
        obstacles_ = obstacles;
        goal_ = nobody;
        is_read_ = false;
    }

    // Steps from `cell` to `goal`. Throws std::invalid_argument if a distance does not fit; so does `fill`.
    Distance steps(int goal, int cell) {
        begin(goal);
        reach(cell);
        return value(cell);
    }

    // Fills the table of a robot at (row, col), whose corner is chosen here.
    void fill(int goal, int row, int col, TableShape shape, std::int32_t* corner, Distance* table) {
        begin(goal);
        place_table(layout_, shape, row, col, corner);
        for (int r = corner[0]; r < corner[0] + shape.rows; ++r) {
            const int first = r * layout_.stride() + corner[1];
            if (by_words()) {
                table = std::copy_n(found_.data() + first, shape.cols, table);
                continue;
            }
            for (int c = 0; c < shape.cols; ++c) {
                reach(first + c);
                *table++ = value(first + c);
            }
        }
    }

private:
    static constexpr int nobody = -1;
    static constexpr std::size_t most_by_words = 64 * 20;

    // On small maps all of the search at once is quicker than a part, and `found_` is what is asked for.
    bool by_words() const { return std::endian::native == std::endian::little && layout_.size() <= most_by_words; }

    // Elsewhere obstacles hold 0, so that one comparison without a branch tells what is new.
    Distance value(int cell) const { return found_[cell] == 0 && cell != goal_ ? unreachable : found_[cell]; }

    void begin(int goal) {
        if (goal == goal_) return;
        const std::size_t size = layout_.size();
        if (by_words()) {
            if (!is_read_) small_.emplace(grid_of(layout_, obstacles_));
            is_read_ = true;
            distances_to(*small_, goal, found_, open_);
            head_ = tail_ = 0;
            goal_ = goal;
            return;
        }
        if (!is_read_) {
            found_.resize(size);
            open_.resize(size);
            for (std::size_t cell = 0; cell < size; ++cell) found_[cell] = obstacles_[cell] == T{0} ? unreachable : 0;
            is_read_ = true;
        } else {
            for (std::size_t i = 0; i < tail_; ++i) found_[open_[i]] = unreachable;
        }
        head_ = 0;
        tail_ = 1;
        open_[0] = goal_ = goal;
        found_[goal] = 0;
    }

    void reach(int cell) {
        while (found_[cell] == unreachable && head_ < tail_) expand();
    }

    // Expands some cells of the queue.
    void expand() {
        constexpr std::size_t many = 128;
        const auto steps = layout_.steps();
        Distance* const found = found_.data();
        int* const open = open_.data();
        const std::size_t end = std::min(head_ + many, tail_);
        std::size_t tail = tail_;
        for (; head_ < end; ++head_) tail = expand_cell(found, open, tail, open[head_], steps);
        tail_ = tail;
    }

    Layout layout_{};
    const T* obstacles_ = nullptr;
    bool is_read_ = false;
    int goal_ = nobody;
    std::optional<Grid> small_;
    std::vector<Distance> found_;
    std::vector<int> open_;
    std::size_t head_ = 0, tail_ = 0;
};

// Swaps of PibtStep by tables that may cover a part of the map; what lies outside is searched for.
template <class T>
struct WaySwaps {
    static constexpr bool on = true;
    const Layout& layout;
    const int* goals;  // cells
    WayTables tables;
    GoalSearch<T>& search;

    bool nearer(int robot, int from, int to) const { return steps(robot, to) < steps(robot, from); }

    Distance steps(int robot, int cell) const {
        if (tables.shape.is_whole(layout)) return tables.steps[robot * tables.shape.size() + cell];
        const int row = layout.row(cell), col = layout.col(cell);
        if (tables.covers(layout, robot, row, col, 0)) return *tables.at(layout, robot, row, col);
        return search.steps(goals[robot], cell);
    }
};

}  // namespace mapf
