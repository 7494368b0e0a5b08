// The paths of all other robots by cell and time, and the constraints on the robot that is planned.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "experts/native/pair_table.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

inline constexpr int forever = std::numeric_limits<int>::max();

// A path: the start and the action of every step; the robot stays where it ends.
struct PathView {
    int start;
    std::span<const std::uint8_t> actions;

    int arrival_time() const { return static_cast<int>(actions.size()); }
};

inline int reversed(int action) { return action ^ 2; }  // up <-> down, left <-> right

// The events in one cell at one time.
struct Passage {
    std::array<std::uint16_t, 4> by_move{};  // robots that enter by this move
    std::uint16_t robots = 0;                // robots in the cell
    std::uint8_t forbidden = 0;              // bit a: the planned robot must not arrive by action a
};

inline constexpr std::uint8_t all_actions = (1u << num_actions) - 1;

class Traffic {
public:
    void reset(const Layout& layout) {
        steps_ = layout.steps();
        passages_.clear();
        settled_.assign(static_cast<std::size_t>(layout.size()), forever);
        horizon_ = 0;
        steps_taken_ = 0;
    }

    void add(const PathView& path) { count(path, 1, path.arrival_time()); }
    void remove(const PathView& path) { count(path, -1, forever); }

    // No path that was added arrives later than this.
    int horizon() const { return horizon_; }

    // True if most of the table holds cells and times that no path passes any more.
    bool is_sparse() const { return passages_.size() > 4 * (steps_taken_ + 1024); }

    void forbid(int cell, int time, std::uint8_t actions) { passages_(cell, time).forbidden |= actions; }
    void allow(int cell, int time) { passages_(cell, time).forbidden = 0; }

    const Passage& at(int cell, int time) const { return passages_.at(cell, time); }

    // Robots met in `cell` at `time`, whose passage is `passage`.
    int vertex_conflicts(const Passage& passage, int cell, int time) const {
        return passage.robots + (time > settled_[cell]);
    }

    // Robots that pass through `cell` after `time`.
    int visits_after(int cell, int time) const {
        int visits = 0;
        for (int later = time + 1; later <= horizon_; ++later) visits += passages_.at(cell, later).robots;
        return visits;
    }

    // Conflicts of `path` with all other robots, while it is not part of the traffic itself.
    int conflicts(const PathView& path) const {
        int cell = path.start, time = 0, found = 0;
        for (const int action : path.actions) {
            ++time;
            if (action != idle) found += passages_.at(cell, time).by_move[reversed(action)];
            cell += steps_[action];
            found += vertex_conflicts(passages_.at(cell, time), cell, time);
        }
        return found + visits_after(cell, time);
    }

private:
    void count(const PathView& path, int sign, int settled) {
        int cell = path.start, time = 0;
        for (const int action : path.actions) {
            cell += steps_[action];
            auto& passage = passages_(cell, ++time);
            passage.robots = static_cast<std::uint16_t>(passage.robots + sign);
            if (action == idle) continue;
            passage.by_move[action] = static_cast<std::uint16_t>(passage.by_move[action] + sign);
        }
        settled_[cell] = settled;
        horizon_ = std::max(horizon_, time);
        steps_taken_ += static_cast<std::size_t>(sign * time);
    }

    std::array<int, num_actions> steps_{};
    PairTable<Passage> passages_;
    std::vector<int> settled_;  // from when on a robot rests in the cell forever
    int horizon_ = 0;
    std::size_t steps_taken_ = 0;  // by all robots together
};

}  // namespace mapf
