// Which moves bring a robot closer to its goal, found only as far as it is asked for: for large maps and many robots.
#pragma once

#include <array>
#include <cstdint>
#include <cstdlib>
#include <utility>
#include <vector>

#include "mapf_env/native/grid.hpp"

namespace mapf {

// Reverse resumable A* (Silver 2005, "Cooperative pathfinding") from the goal towards the start. The Manhattan distance
// to the start changes by one with every move, so open cells have one of two estimates, and two stacks take the place
// of a heap. Neighbours' distances differ by exactly one, so distances modulo three tell which is closer: two bits a
// cell.
class Guidance {
public:
    Guidance(const Grid& grid, int start, int goal)
        : grid_(&grid), steps_(grid.layout.steps()), thorough_(grid.blocked.size() < large_map),
          residues_(grid.blocked.size() / cells_in_byte + 1, 0) {
        const auto& layout = grid.layout;
        const int rows = layout.row(goal) - layout.row(start), cols = layout.col(goal) - layout.col(start);
        estimate_ = std::abs(rows) + std::abs(cols);
        now_.push_back({goal, rows, cols});
        search(start);
        distance_ = estimate_;
    }

    // Steps from the start to the goal.
    int distance() const { return distance_; }

    // By how much the robot is further from its goal in `next` than in its neighbour `cell`: -1 or 1. Neither may be
    // an obstacle. On large maps, of several shortest ways only one or a few are found, and the others count as longer.
    int detour(int cell, int next) {
        if (residue(cell) == unknown) search(cell);
        if (residue(next) == unknown) {
            if (!thorough_) return 1;
            search(next);
        }
        return (residue(next) - residue(cell) + 3) % 3 == 1 ? 1 : -1;
    }

private:
    static constexpr std::size_t cells_in_byte = 4;
    static constexpr int unknown = 0;
    static constexpr std::size_t large_map = 128 * 128;

    struct Open {
        int cell;
        int rows, cols;  // below and right of the start
    };

    int residue(int cell) const { return residues_[byte_of(cell)] >> shift_of(cell) & 3; }
    static std::size_t byte_of(int cell) { return static_cast<unsigned>(cell) / cells_in_byte; }
    static int shift_of(int cell) { return 2 * (cell & 3); }

    // Goes on until the distance of `cell` is known. The hot loop of large maps.
    void search(int cell) {
        const std::uint8_t* const blocked = grid_->blocked.data();
        std::uint8_t* const residues = residues_.data();
        while (residue(cell) == unknown) {
            if (now_.empty()) {
                if (later_.empty()) return;
                std::swap(now_, later_);
                estimate_ += 2;
            }
            const auto here = now_.back();
            now_.pop_back();
            auto& known = residues[byte_of(here.cell)];
            if (known >> shift_of(here.cell) & 3) continue;
            const auto found = static_cast<unsigned>(estimate_ - std::abs(here.rows) - std::abs(here.cols));
            known = static_cast<std::uint8_t>(known | (1 + found % 3) << shift_of(here.cell));
            const auto open = [&](int action, bool nearer) {
                const int next = here.cell + steps_[action];
                if ((residues[byte_of(next)] >> shift_of(next) & 3) != unknown || blocked[next]) return;
                (nearer ? now_ : later_)
                    .push_back({next, here.rows + row_step[action], here.cols + col_step[action]});
            };
            open(0, here.rows > 0);
            open(1, here.cols > 0);
            open(2, here.rows < 0);
            open(3, here.cols < 0);
        }
    }

    const Grid* grid_;
    std::array<int, num_actions> steps_;
    bool thorough_;
    std::vector<std::uint8_t> residues_;  // 1 + the distance modulo 3
    std::vector<Open> now_, later_;       // with the lowest estimate, and with the next
    int estimate_ = 0, distance_ = 0;
};

}  // namespace mapf
