// One step of priority inheritance with backtracking (Okumura, Machida, Defago and Tamura 2022, "Priority inheritance
// with backtracking for iterative multi-agent path finding"): a joint move without conflicts, whatever the preferences.
//
// Robots plan in order of priority. plan(robot) goes through the robot's candidates, the most preferred first:
//     1. skip a cell that is blocked, reserved, or left by a robot that comes the other way (a swap conflict)
//     2. reserve the cell
//     3. priority inheritance: a robot that stands there and has no move yet plans next, with this robot's priority
//     4. backtracking: if that robot finds no move, try the next candidate; with none left, stay and report failure
//
//     priority 1, 2, 3 from the left; everybody wants to go right, and # is an obstacle:
//         1 > 2 > 3 #     1 reserves 2's cell, so 2 plans; 2 reserves 3's cell, so 3 plans; 3 finds no free cell
//                         and fails, then 2 looks for another cell, then 1
//
// Invariant: the cells in next_ are distinct and no two robots exchange cells, also while a push is backtracked.
//
// With swaps (Okumura 2023, "Improving LaCAM for scalable eventually optimal multi-agent pathfinding") two robots that
// face each other in a corridor change places: one backs out to where the corridor branches, and pulls the other along:
//
//     a > < b . .     b has to give way: it takes its candidates in reverse order, which leads it away from its goal,
//           .         and a follows into the cell that b leaves, until b can step aside into the branch
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "mapf_env/native/grid.hpp"

namespace mapf {

// No swaps: the original PIBT.
struct NoSwaps {
    static constexpr bool on = false;
};

// Swaps by tables of distances: distance_of(robot) is the table of its distances to goals[robot].
template <class DistanceOf>
struct TableSwaps {
    static constexpr bool on = true;
    std::span<const int> goals;
    DistanceOf distance_of;

    bool nearer(int robot, int from, int to) const { return distance_of(robot)[to] < distance_of(robot)[from]; }
};

// Plans steps on maps of one layout with border >= 1; obstacles are the cells that are not T{0}. Arrays are reused.
template <class T = std::uint8_t>
class PibtStep {
public:
    explicit PibtStep(const Layout& layout)
        : steps_(layout.steps()), now_(layout.size(), nobody), next_(layout.size(), nobody) {}

    // Decides each robot's action. `cells` (N) are distinct; `order` (N) names the robots, the most important first;
    // `preferences` (N * 5) holds each robot's five actions, the most wanted first.
    template <class Swaps = NoSwaps>
    void decide(const T* blocked, std::span<const int> cells, std::span<const int> order,
                std::span<const std::uint8_t> preferences, std::span<std::uint8_t> actions, const Swaps& swaps = {}) {
        std::fill(actions.begin(), actions.end(), undecided);
        complete(blocked, cells, order, preferences, actions, swaps);
    }

    static constexpr std::uint8_t undecided = num_actions;

    // Decides for the robots whose action is `undecided`; the actions of the others are fixed. Returns true if all
    // actions are compatible; fixed moves can make that impossible. `swaps` (NoSwaps, or with `goals` and nearer(robot,
    // from, to): true if `to` is nearer to the robot's goal than its neighbour `from`) decides who changes places.
    template <class Swaps = NoSwaps>
    bool complete(const T* blocked, std::span<const int> cells, std::span<const int> order,
                  std::span<const std::uint8_t> preferences, std::span<std::uint8_t> actions, const Swaps& swaps = {}) {
        blocked_ = blocked;
        cells_ = cells;
        preferences_ = preferences;
        actions_ = actions;
        bool possible = true;
        for (std::size_t robot = 0; robot < cells.size(); ++robot) now_[cells[robot]] = static_cast<int>(robot);
        for (std::size_t robot = 0; robot < cells.size(); ++robot)
            if (actions[robot] != undecided) possible = possible && fix(static_cast<int>(robot));
        for (const int robot : order)
            if (possible && actions[robot] == undecided) possible = plan(robot, nobody, swaps) || next_[cells[robot]] == robot;
        for (std::size_t robot = 0; robot < cells.size(); ++robot) {
            now_[cells[robot]] = nobody;
            for (const int step : steps_) next_[cells[robot] + step] = nobody;
        }
        return possible;
    }

private:
    static constexpr int nobody = -1;

    // Reserves the target of a fixed move; returns false if it conflicts with the moves fixed before.
    bool fix(int robot) {
        const int cell = cells_[robot], target = cell + steps_[actions_[robot]];
        if (next_[target] != nobody) return false;
        next_[target] = robot;
        const int other = now_[target];
        return other == nobody || other == robot || next_[cell] != other;
    }

    struct Candidates {
        std::array<std::uint8_t, num_actions> action{};
        int count = 0;
    };

    // A robot that looks for a move, and how far it has come.
    struct Plan {
        int robot, pusher, partner = nobody, rank = 0;
        Candidates candidates{};
    };

    template <class Swaps>
    Plan plan_of(int robot, int pusher, const Swaps& swaps) const {
        Plan plan{robot, pusher};
        if constexpr (Swaps::on) {
            // Swap: the robot that has to give way takes its candidates in reverse order, which leads it out backwards.
            auto& [action, count] = plan.candidates = candidates_of(robot);
            plan.partner = swap_partner(robot, cells_[robot] + steps_[action[0]], swaps);
            if (plan.partner != nobody) std::reverse(action.begin(), action.begin() + count);
        } else {
            plan.candidates.count = num_actions;
            std::copy_n(preferences_.data() + static_cast<std::size_t>(robot) * num_actions, num_actions,
                        plan.candidates.action.begin());
        }
        return plan;
    }

    // Finds a move for the robot and those it pushes. If there is none it returns false, and the robot stays. Pushes can
    // be as long as the team is large, so they are on a stack of their own.
    template <class Swaps>
    bool plan(int robot, int pusher, const Swaps& swaps) {
        Plan first = plan_of(robot, pusher, swaps);
        int pushed = nobody;
        const bool goes = advance(first, pushed);
        if (pushed == nobody) {  // as nearly always: no stack is needed
            if (!goes) step_back(first);
            return goes;
        }
        plans_.assign({first, plan_of(pushed, robot, swaps)});
        while (true) {
            pushed = nobody;
            const bool moves = advance(plans_.back(), pushed);
            if (pushed != nobody) {  // 3. Priority inheritance: a robot that stands there has to find a move of its own.
                plans_.push_back(plan_of(pushed, plans_.back().robot, swaps));
                continue;
            }
            if (!moves) step_back(plans_.back());
            plans_.pop_back();
            bool found = moves;
            while (found && !plans_.empty()) {
                pull(plans_.back());
                plans_.pop_back();
            }
            if (plans_.empty()) return found;
            ++plans_.back().rank;  // the robot in the way cannot make room
        }
    }

    // Reserves the next cell that the robot can have, and returns true if it can move there now; `pushed` is the robot
    // that has to leave that cell first, if there is one.
    bool advance(Plan& plan, int& pushed) {
        const int robot = plan.robot, cell = cells_[robot];
        for (; plan.rank < plan.candidates.count; ++plan.rank) {
            const std::uint8_t action = plan.candidates.action[plan.rank];
            const int target = cell + steps_[action];
            // 1. Skip cells that cannot be entered.
            if (blocked_[target] != T{0} || next_[target] != nobody) continue;
            const int other = now_[target];
            const bool occupied = other != nobody && other != robot;
            if (occupied && actions_[other] != undecided && cells_[other] + steps_[actions_[other]] == cell) continue;
            // 2. Reserve the cell.
            actions_[robot] = action;
            next_[target] = robot;
            if (occupied && actions_[other] == undecided) {
                pushed = other;
                return false;
            }
            pull(plan);
            return true;
        }
        return false;
    }

    // 4. Backtracking: the robot stays; a robot that has reserved its cell gives it up, unless that move was fixed.
    void step_back(const Plan& plan) {
        const int cell = cells_[plan.robot], claimant = next_[cell];
        if (claimant != nobody && claimant != plan.pusher) return;
        actions_[plan.robot] = idle;
        next_[cell] = plan.robot;
    }

    // The actions that stay on the map, in the order of preference.
    Candidates candidates_of(int robot) const {
        Candidates candidates;
        for (int rank = 0; rank < num_actions; ++rank) {
            const std::uint8_t action = preferences_[robot * num_actions + rank];
            if (blocked_[cells_[robot] + steps_[action]] == T{0}) candidates.action[candidates.count++] = action;
        }
        return candidates;
    }

    // Pull: the partner takes the cell that the robot leaves, if neither of them is promised to anyone else.
    void pull(const Plan& plan) {
        const int partner = plan.partner, cell = cells_[plan.robot];
        if (plan.rank != 0 || partner == nobody || actions_[partner] != undecided || next_[cell] != nobody) return;
        next_[cell] = partner;
        actions_[partner] = static_cast<std::uint8_t>(std::find(steps_.begin(), steps_.end(), cell - cells_[partner]) -
                                                      steps_.begin());
    }

    // The robot with which `robot`, which wants to enter `target`, has to change places and can; or nobody.
    template <class Swaps>
    int swap_partner(int robot, int target, const Swaps& swaps) const {
        const int cell = cells_[robot];
        if (target == cell) return nobody;
        // The robot ahead comes the other way.
        const int ahead = now_[target];
        if (ahead != nobody && actions_[ahead] == undecided && swap_required(robot, ahead, cell, target, swaps) &&
            swap_possible(target, cell, swaps))
            return ahead;
        // Clear operation: a neighbour would have to swap if this robot went ahead, so this robot waits outside.
        for (int action = 0; action < idle; ++action) {
            const int side = cell + steps_[action], other = now_[side];
            if (other == nobody || side == target) continue;
            if (swap_required(other, robot, cell, target, swaps) && swap_possible(target, cell, swaps)) return other;
        }
        return nobody;
    }

    // A cell's ways on, except back to `from` and into dead ends whose robot rests on its goal.
    struct Ways {
        int count = 0, last = nobody;
    };

    template <class Swaps>
    Ways ways_on(int from, int cell, const Swaps& swaps) const {
        Ways ways;
        for (int action = 0; action < idle; ++action) {
            const int next = cell + steps_[action];
            if (next == from || blocked_[next] != T{0}) continue;
            if (const int robot = now_[next]; robot != nobody && swaps.goals[robot] == next && is_dead_end(next)) continue;
            ways = {ways.count + 1, next};
        }
        return ways;
    }

    bool is_dead_end(int cell) const {
        int degree = 0;
        for (int action = 0; action < idle; ++action) degree += blocked_[cell + steps_[action]] == T{0};
        return degree == 1;
    }

    // True if the pusher in cell `back` cannot pass the puller in cell `front` ahead of it: it pushes it on until the
    // corridor ends, and there each of them still wants to go where the other one is.
    template <class Swaps>
    bool swap_required(int pusher, int puller, int back, int front, const Swaps& swaps) const {
        while (swaps.nearer(pusher, back, front)) {
            const auto ways = ways_on(back, front, swaps);
            if (ways.count > 1) return false;
            if (ways.count == 0) break;
            back = front;
            front = ways.last;
        }
        return swaps.nearer(puller, front, back) &&
               (swaps.goals[pusher] == back || swaps.nearer(pusher, back, front));
    }

    // True if a robot that backs out of `cell`, away from `ahead`, comes to a branch where it can let another one pass.
    template <class Swaps>
    bool swap_possible(int ahead, int cell, const Swaps& swaps) const {
        for (const int origin = ahead; cell != origin;) {
            const auto ways = ways_on(ahead, cell, swaps);
            if (ways.count != 1) return ways.count > 1;
            ahead = cell;
            cell = ways.last;
        }
        return false;
    }

    std::array<int, num_actions> steps_;
    std::vector<int> now_, next_;  // the robot in each cell now and after the step, or nobody
    const T* blocked_ = nullptr;
    std::span<const int> cells_;
    std::span<const std::uint8_t> preferences_;
    std::span<std::uint8_t> actions_;
    std::vector<Plan> plans_;
};

}  // namespace mapf
