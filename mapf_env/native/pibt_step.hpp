// One step of priority inheritance with backtracking (Okumura, Machida, Defago and Tamura 2022, "Priority inheritance
// with backtracking for iterative multi-agent path finding"): joint moves without a conflict, whatever is preferred.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "mapf_env/native/grid.hpp"

namespace mapf {

// The memory of the steps on maps of one layout, pad >= 1, whose obstacles are the cells that are not T{0}.
template <class T = std::uint8_t>
class PibtStep {
public:
    explicit PibtStep(const Layout& layout)
        : steps_(layout.steps()), now_(layout.size(), nobody), next_(layout.size(), nobody) {}

    // Decides each robot's action. `cells` (N) are distinct; `order` (N) names the robots, the most important first;
    // `preferences` (N * 5) holds each robot's five actions, the most wanted first.
    void decide(const T* blocked, std::span<const int> cells, std::span<const int> order,
                std::span<const std::uint8_t> preferences, std::span<std::uint8_t> actions) {
        std::fill(actions.begin(), actions.end(), undecided);
        complete(blocked, cells, order, preferences, actions);
    }

    static constexpr std::uint8_t undecided = num_actions;

    // The same for the robots whose action is `undecided`; what the others do is fixed. Returns whether all goes
    // together, which may not be where moves are fixed.
    bool complete(const T* blocked, std::span<const int> cells, std::span<const int> order,
                  std::span<const std::uint8_t> preferences, std::span<std::uint8_t> actions) {
        blocked_ = blocked;
        cells_ = cells;
        preferences_ = preferences;
        actions_ = actions;
        bool possible = true;
        for (std::size_t robot = 0; robot < cells.size(); ++robot) now_[cells[robot]] = static_cast<int>(robot);
        for (std::size_t robot = 0; robot < cells.size(); ++robot)
            if (actions[robot] != undecided) possible = possible && fix(static_cast<int>(robot));
        for (const int robot : order)
            if (possible && actions[robot] == undecided) possible = plan(robot) || next_[cells[robot]] == robot;
        for (std::size_t robot = 0; robot < cells.size(); ++robot) {
            now_[cells[robot]] = nobody;
            for (const int step : steps_) next_[cells[robot] + step] = nobody;
        }
        return possible;
    }

private:
    static constexpr int nobody = -1;

    // Whether the move that is fixed for the robot goes with those fixed before.
    bool fix(int robot) {
        const int cell = cells_[robot], target = cell + steps_[actions_[robot]];
        if (next_[target] != nobody) return false;
        next_[target] = robot;
        const int other = now_[target];
        return other == nobody || other == robot || next_[cell] != other;
    }

    // Whether the robot finds a move for itself and those it pushes; else it stays, which its pusher has to accept.
    bool plan(int robot, int pusher = nobody) {
        const int cell = cells_[robot];
        for (int rank = 0; rank < num_actions; ++rank) {
            const std::uint8_t action = preferences_[robot * num_actions + rank];
            const int target = cell + steps_[action];
            if (blocked_[target] != T{0} || next_[target] != nobody) continue;
            const int other = now_[target];
            const bool occupied = other != nobody && other != robot;
            if (occupied && actions_[other] != undecided && cells_[other] + steps_[actions_[other]] == cell) continue;
            actions_[robot] = action;
            next_[target] = robot;
            if (!occupied || actions_[other] != undecided || plan(other, robot)) return true;
        }
        // Whoever wants the cell has to step back, unless the move was fixed.
        const int claimant = next_[cell];
        if (claimant == nobody || claimant == pusher) {
            actions_[robot] = idle;
            next_[cell] = robot;
        }
        return false;
    }

    std::array<int, num_actions> steps_;
    std::vector<int> now_, next_;  // who is in a cell, who will be
    const T* blocked_ = nullptr;
    std::span<const int> cells_;
    std::span<const std::uint8_t> preferences_;
    std::span<std::uint8_t> actions_;
};

}  // namespace mapf
