// Lazy constraints addition search: a complete search over joint states that PIBT leads to the goal.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
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
    std::int64_t cost() const {
        std::int64_t sum = 0;
        for (const auto& actions : of_robot) sum += static_cast<std::int64_t>(actions.size());
        return sum;
    }
    std::size_t makespan() const {
        std::size_t latest = 0;
        for (const auto& actions : of_robot) latest = std::max(latest, actions.size());
        return latest;
    }
};

// LaCAM (Okumura 2023, "LaCAM: search-based algorithm for quick multi-agent pathfinding"): a depth-first search over
// configurations, which are joint states. PIBT with swap (Okumura 2023, "Improving LaCAM for scalable eventually optimal
// multi-agent pathfinding") is the configuration generator. A second, breadth-first search in each node adds constraints
// on its successor: who goes where.
//
// Invariant: a configuration is generated once, and its node stays open until all its constraints were tried. So a
// search that ends has seen every configuration that can be reached.
//
// How long a search takes depends on luck. So the complete search takes turns with probes, which begin again with other
// random choices, half of them from the goals: a plan from there, read backwards, is a plan. The lengths of the turns
// follow Luby, Sinclair and Zuckerman 1993.
class Lacam {
public:
    Lacam(const Grid& grid, std::span<const int> starts, std::span<const int> goals, std::uint64_t seed);
    Lacam(const Lacam&) = delete;
    Lacam& operator=(const Lacam&) = delete;

    // What all calls of run() together may do.
    struct Limits {
        std::size_t nodes, expansions;
    };
    // The limits that bound the memory by a number of nodes: constraints need memory too.
    static Limits limits_of(std::size_t nodes) { return {nodes, nodes < (std::size_t{1} << 60) ? 4 * nodes : nodes}; }

    // Searches until a plan is found or a limit is reached, which is `node_limit` for both numbers of `limits`. A later
    // call with higher limits goes on from there.
    Status run(const Limits& limits, Budget& budget);

    std::int64_t lower_bound() const { return lower_bound_; }  // the sum of the distances
    std::size_t expansions() const { return expansions_; }
    std::size_t generated() const { return dropped_ + complete_.nodes.size() + probe_.nodes.size(); }

    // The plan that was found, if it was solved.
    JointPlan plan() const;

private:
    // The robot `order[depth - 1]` of a node goes to `cell`, and those before it as `parent` says.
    struct Constraint {
        int parent, cell, depth;
    };
    struct Node {
        int parent;
        std::vector<int> order;              // robots under way first, those with the longest way first
        std::vector<Constraint> constraints; // a tree, which is read breadth first
        std::size_t next_constraint = 0;
    };
    // A problem that a tree is of: the given one, or from its goals to its starts.
    struct Direction {
        std::span<const int> starts, goals;
        std::vector<Guidance> guidance;
    };
    struct Tree {
        Direction* direction;
        std::vector<Node> nodes;
        std::vector<int> states;  // of all nodes, one after the other
        std::unordered_multimap<std::uint64_t, int> known;
        std::vector<int> open;  // a stack
        Random random;
        int goal_node = -1;

        Tree(Direction& direction, std::uint64_t seed) : direction(&direction), random(seed) {}
    };

    bool measure(Direction& direction, Budget& budget);
    bool begin_turn(Budget& budget);
    void plant(bool longest_first);
    std::optional<Status> search(std::size_t expansion_limit, std::size_t node_limit, Budget& budget);
    std::span<const int> state(const Tree& tree, int node) const {
        return std::span(tree.states).subspan(static_cast<std::size_t>(node) * num_robots_, num_robots_);
    }
    int add(int parent, std::vector<int> order);
    int find(std::span<const int> cells) const;
    void constrain(int node, int constraint);
    bool make_successor(int node, const Constraint& constraint);
    void prefer(int robot, int cell, std::uint8_t* preferences);
    std::uint64_t hash(std::span<const int> cells) const;

    const Grid& grid_;
    std::size_t num_robots_;
    std::uint64_t seed_;
    PibtStep<> step_;
    Direction forward_, backward_;
    Tree complete_, probe_;
    Tree* tree_ = nullptr;  // the one whose turn it is
    std::vector<int> new_state_;
    std::vector<std::uint8_t> preferences_, actions_;
    std::int64_t lower_bound_ = 0;
    std::size_t longest_ = 0;  // of the distances
    std::size_t expansions_ = 0;
    std::size_t turns_ = 0, turn_end_ = 0;  // turns begun; the expansions at which the last one ends
    std::size_t dropped_ = 0;               // nodes of earlier probes
};

}  // namespace mapf
