// Lazy constraints addition search: a complete search over joint states that PIBT leads to the goal.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <unordered_map>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/guidance.hpp"
#include "mapf_env/native/pibt_step.hpp"
#include "experts/native/problem.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

// Each robot's actions until it arrives.
struct JointPlan {
    std::vector<std::vector<std::uint8_t>> of_robot;

    std::span<const std::uint8_t> actions(std::size_t robot) const { return of_robot[robot]; }
};

// Okumura 2023, "LaCAM: search-based algorithm for quick multi-agent pathfinding". A node is a joint state; PIBT makes
// its next successor under the constraints of a second, breadth-first search, which names where some robots go.
class Lacam {
public:
    Lacam(const Grid& grid, std::span<const int> starts, std::span<const int> goals, std::uint64_t seed);

    // Generates `node_limit` joint states at most.
    Status run(std::size_t node_limit, Budget& budget);

    std::int64_t lower_bound() const { return lower_bound_; }  // the sum of the distances
    std::size_t expansions() const { return expansions_; }
    std::size_t generated() const { return nodes_.size(); }

    // The plan that was found, if it was solved.
    JointPlan plan() const;

private:
    // Where the robot `order[depth - 1]` of a node goes, and the same of those before it.
    struct Constraint {
        int parent, cell, depth;
    };
    struct Node {
        int parent;
        std::vector<int> order;              // robots under way first, the longest first
        std::vector<Constraint> constraints; // a tree, which is read breadth first
        std::size_t next_constraint = 0;
    };

    std::span<const int> state(int node) const {
        return std::span(states_).subspan(static_cast<std::size_t>(node) * starts_.size(), starts_.size());
    }
    int add(int parent);
    int find(std::span<const int> cells) const;
    bool make_successor(int node, const Constraint& constraint);
    void prefer(int robot, int cell, std::uint8_t* preferences);
    std::uint64_t hash(std::span<const int> cells) const;

    const Grid& grid_;
    std::span<const int> starts_, goals_;
    Random random_;
    PibtStep<> step_;
    std::vector<Guidance> guidance_;
    std::vector<Node> nodes_;
    std::vector<int> states_;  // of all nodes, one after the other
    std::unordered_multimap<std::uint64_t, int> known_;
    std::vector<int> open_;  // a stack
    std::vector<int> new_state_;
    std::vector<std::uint8_t> preferences_, actions_;
    std::int64_t lower_bound_ = 0;
    std::size_t expansions_ = 0;
    int goal_node_ = -1;
};

}  // namespace mapf
