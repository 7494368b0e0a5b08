// LaCAM, lazy constraints addition search: a complete search over configurations (joint states), guided by PIBT.
//
// High level: depth first over configurations. Low level: each node has a lazily built tree of constraints on its
// successor, read breadth first; depth k of that tree fixes the cells of the first k robots of the node's order:
//
//     {}                           try 1: PIBT decides for all robots
//     |-- r7 -> a                  tries 2 to 4: the first robot is fixed, PIBT decides for the others
//     |   |-- r7 -> a, r2 -> c     and so on, down to constraints that fix every robot
//     |   `-- ...
//     |-- r7 -> b
//     `-- r7 stays
//
// One turn of the loop in search():
//     1. look at the newest node of OPEN (a stack); if it is the goal configuration, its ancestors are the plan
//     2. take its next constraint and append that constraint's children to its queue
//     3. configuration generator: PIBT with swap makes a successor that obeys the constraint, or fails
//     4. a new configuration becomes a node; a known one goes to the top of OPEN again
//
// A node is popped only when its constraints are used up, that is, when every successor was generated. With 5^N joint
// moves that is hopeless, but PIBT's first suggestions nearly always lead on.
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
// Invariant: each configuration has one node, which stays in OPEN until all its constraints have been tried. So a search
// that ends without a plan has seen every reachable configuration, and the problem is infeasible.
//
// The time of such a search varies widely with the random choices. So the complete search takes turns with probes, which
// restart with other random choices; half of them search from the goals, and their plans are read backwards. The lengths
// of the turns follow Luby, Sinclair and Zuckerman 1993.
class Lacam {
public:
    Lacam(const Grid& grid, std::span<const int> starts, std::span<const int> goals, std::uint64_t seed);
    Lacam(const Lacam&) = delete;
    Lacam& operator=(const Lacam&) = delete;

    // Limits on all calls of run() together.
    struct Limits {
        std::size_t nodes, expansions;
    };
    // The limits that bound the memory by a number of nodes: constraints need memory too.
    static Limits limits_of(std::size_t nodes) { return {nodes, nodes < (std::size_t{1} << 60) ? 4 * nodes : nodes}; }

    // Searches until a plan is found or a limit is reached (Status::node_limit for both numbers of `limits`). A later call
    // with higher limits continues from there.
    Status run(const Limits& limits, Budget& budget);

    std::int64_t lower_bound() const { return lower_bound_; }  // the sum of the distances
    std::size_t expansions() const { return expansions_; }
    std::size_t generated() const { return dropped_ + complete_.nodes.size() + probe_.nodes.size(); }

    // The plan, if run() returned Status::solved.
    JointPlan plan() const;

private:
    // The robot `order[depth - 1]` of a node goes to `cell`; the constraint `parent` fixes the robots before it.
    struct Constraint {
        int parent, cell, depth;
    };
    struct Node {
        int parent;
        std::vector<int> order;              // robots off their goals first, the longest distance first
        std::vector<Constraint> constraints; // the tree, in breadth-first order
        std::size_t next_constraint = 0;
    };
    // The problem that a tree searches: the given one, or the reverse from goals to starts.
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

    bool compute_distances(Direction& direction, Budget& budget);
    bool begin_turn(Budget& budget);
    void add_root(bool longest_first);
    std::optional<Status> search(std::size_t expansion_limit, std::size_t node_limit, Budget& budget);
    std::span<const int> state(const Tree& tree, int node) const {
        return std::span(tree.states).subspan(static_cast<std::size_t>(node) * num_robots_, num_robots_);
    }
    int add(int parent, std::vector<int> order);
    int find_node(std::span<const int> cells) const;
    void add_constraints(int node, int constraint);
    bool generate_successor(int node, const Constraint& constraint);
    void prefer(int robot, int cell, std::uint8_t* preferences);
    std::uint64_t hash(std::span<const int> cells) const;

    const Grid& grid_;
    std::size_t num_robots_;
    std::uint64_t seed_;
    PibtStep<> step_;
    Direction forward_, backward_;
    Tree complete_, probe_;
    Tree* tree_ = nullptr;  // of the current turn
    std::vector<int> new_state_;
    std::vector<std::uint8_t> preferences_, actions_;
    std::int64_t lower_bound_ = 0;
    std::size_t longest_ = 0;  // of the distances
    std::size_t expansions_ = 0;
    std::size_t turns_ = 0, turn_end_ = 0;  // turns begun; the expansions at which the last one ends
    std::size_t dropped_ = 0;               // nodes of earlier probes
};

}  // namespace mapf
