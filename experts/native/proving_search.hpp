// Conflict-based search with the DG heuristic, which proves optimality or a lower bound.
//
// A node of the constraint tree (CT) holds constraints, and for each robot a shortest path that obeys them. Its cost is
// the sum of the paths' lengths. The search is best-first by f = cost + h:
//
//     root: no constraints, f = 20
//     |-- robot 3 arrives at 9 or later, f = 21
//     |   |-- ...
//     |   `-- ...
//     `-- robot 3 arrives by 8, robot 5 at 7 or later, f = 22
//
// One turn of the loop in run():
//     1. take the node with the lowest f from OPEN; that f is a lower bound on the optimum
//     2. find the first conflict of each pair of robots; a node without conflicts is a plan
//     3. build the dependency graph (DG) of the pairs that conflict: an edge joins two robots if no two of their
//        shortest paths are compatible; h is the size of a minimum vertex cover. If f has grown, the node goes back
//        into OPEN.
//     4. choose a conflict and split on it; a child that removes conflicts at the same cost replaces both (bypass)
//
// Invariant: every plan of the problem obeys the constraints of some node in OPEN, and costs at least that node's f.
// Therefore the lowest f never exceeds the optimum, and OPEN is empty only if there is no plan.
//
// Names: `bound` is f, `planned_under` is the CT node whose constraints a stored path was planned under (its diagram
// holds all paths that are as short), `loaded_` the paths of the node that is being worked on.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/decision_diagram.hpp"
#include "experts/native/problem.hpp"
#include "experts/native/traffic.hpp"
#include "experts/native/vertex_cover.hpp"

namespace mapf {

// Two robots are dependent if no two of their shortest paths are compatible (Li, Felner, Boyarski, Ma and Koenig 2019,
// "Improved heuristics for multi-agent path finding with conflict-based search"). Then one of the two takes longer, so a
// vertex cover of the dependent pairs is a lower bound on the growth of the node's cost. The node is split on the robot
// that takes longer: the first does, or it does not and the second does. Such a split excludes whole rectangles,
// corridors and blocked goals at once, and its children share no plan.
class ProvingSearch {
public:
    // Creates the root from shortest paths of all robots, which may conflict: path_of(robot) is a span of actions.
    template <class PathOf>
    void begin(const Problem& problem, const PathOf& path_of) {
        reset(problem);
        for (std::size_t robot = 0; robot < num_robots_; ++robot)
            root_paths_[robot] = store(static_cast<int>(robot), 0, path_of(robot));
        open_root();
    }

    enum class Outcome : std::uint8_t { proved, paused, infeasible };

    // Continues until a plan of cost at most w * lower_bound() is known, or `nodes` nodes have been generated in all.
    // `known` is the cost of a plan that another search has found.
    Outcome run(double w, std::int64_t known, std::size_t nodes, Budget& budget);

    std::int64_t lower_bound() const { return lower_bound_; }
    std::size_t expansions() const { return expansions_; }
    std::size_t generated() const { return nodes_.size(); }

    // The cheapest conflict-free plan found so far (the incumbent), if any.
    bool has_plan() const { return best_ >= 0; }
    std::int64_t cost() const { return nodes_[best_].cost; }
    std::span<const std::uint8_t> actions(std::size_t robot) const { return stored(best_paths_[robot]); }

private:
    struct Constraint {
        int robot = -1;
        Constraints::Ban ban{0, 0, 0};
        int earliest = 0, latest = forever;
    };
    // A path, and the node whose constraints it was planned under: it is a shortest path that obeys them.
    struct StoredPath {
        int robot, planned_under;
        std::size_t begin;
        int length;
    };
    struct Change {
        int robot, path;
    };
    struct Node {
        int parent, cost, bound, conflicts;  // bound: f, the least cost of any plan in this subtree
        bool has_heuristic;                  // true if `bound` includes h
        std::array<Constraint, 2> constraints;
        std::size_t first_change;
        int changes;
    };
    struct Conflict {
        int first, second, cell, time;  // for swaps, `first` moves to `cell`
        int action;                     // of `first` in a swap, else idle
        bool at_rest;                   // a target conflict: `first` rests on its goal
    };
    struct Open {
        int bound, conflicts, id;
    };
    struct CachedDiagram {
        int robot = -1, planned_under = -1;
        DecisionDiagram diagram;
    };
    struct CachedPair {
        std::array<int, 4> key{-1, -1, -1, -1};
        bool dependent = false;
    };

    static bool is_worse(const Open& a, const Open& b) {
        if (a.bound != b.bound) return a.bound > b.bound;
        if (a.conflicts != b.conflicts) return a.conflicts > b.conflicts;
        return a.id < b.id;
    }

    void reset(const Problem& problem);
    void open_root();
    void push(int id);
    int pop();
    void load(int id);
    void find_conflicts();
    void add_conflict(int first, int second, int cell, int time, int action);
    bool compute_heuristic(int id, Budget& budget);
    void expand(int id, Budget& budget);
    const Conflict& choose_conflict(Budget& budget);
    int conflict_rank(const Conflict& conflict, Budget& budget);
    int make_child(int id, const std::array<Constraint, 2>& constraints, Budget& budget);
    bool visits(int robot, int goal, int since) const;
    bool replan(int child, int robot, Budget& budget);
    void insert(int id);
    bool are_dependent(int first, int second, Budget& budget);
    const DecisionDiagram& diagram(int robot, int planned_under, const DecisionDiagram* other, Budget& budget);
    void collect_constraints(int robot, int planned_under);
    int store(int robot, int planned_under, std::span<const std::uint8_t> actions);
    std::span<const std::uint8_t> stored(int path) const;
    PathView view(int path) const;

    const Problem* problem_ = nullptr;  // during a search
    std::size_t num_robots_ = 0;
    std::vector<Node> nodes_;
    std::vector<Change> changes_;
    std::vector<StoredPath> paths_;
    std::vector<std::uint8_t> actions_;
    std::vector<Open> open_;  // a heap
    std::vector<int> root_paths_, loaded_, wanted_, best_paths_;
    int best_ = -1;
    std::int64_t lower_bound_ = 0;
    std::size_t expansions_ = 0;

    Traffic traffic_;
    DiagramBuilder builder_;
    JointSearch joint_;
    VertexCover cover_;
    Constraints constraints_;
    std::vector<CachedDiagram> diagrams_;
    std::vector<CachedPair> pairs_;
    std::vector<std::uint8_t> new_actions_;

    std::vector<Conflict> conflicts_;  // of the loaded node, one for each pair
    std::vector<int> cells_, previous_cells_, occupant_, previous_occupant_;
    std::vector<VertexCover::Edge> dependent_;
};

}  // namespace mapf
