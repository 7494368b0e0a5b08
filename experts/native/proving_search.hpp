// Best-first conflict-based search that reasons about pairs of robots: the proof of optimality, or of a lower bound.
//
// Invariant: every plan of the problem obeys the constraints of some open node, and costs at least that node's bound.
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

// Two robots depend on one another if no two of their shortest paths go together (Li, Felner, Boyarski, Ma and Koenig
// 2019, "Improved heuristics for multi-agent path finding with conflict-based search"). One of the two takes longer
// then, so a vertex cover of the dependent pairs is a lower bound of what a node's cost has to grow by; and a node is
// split on who: the first takes longer, or it does not and the second does. That constraints out whole rectangles, corridors
// and blocked goals at once, and no plan is looked for on both sides.
class ProvingSearch {
public:
    // Begins with shortest paths of all robots, which may conflict: path_of(robot) is a span of actions.
    template <class PathOf>
    void begin(const Problem& problem, const PathOf& path_of) {
        reset(problem);
        for (std::size_t robot = 0; robot < num_robots_; ++robot)
            root_tracks_[robot] = store(static_cast<int>(robot), 0, path_of(robot));
        open_root();
    }

    enum class Outcome : std::uint8_t { proved, paused, infeasible };

    // Goes on until there is a plan of cost at most w * lower_bound(), among them `known` (a cost from elsewhere), or
    // `nodes` nodes have been generated in all.
    Outcome run(double w, std::int64_t known, std::size_t nodes, Budget& budget);

    std::int64_t lower_bound() const { return lower_bound_; }
    std::size_t expansions() const { return expansions_; }
    std::size_t generated() const { return nodes_.size(); }

    // The cheapest plan that was come across, if any.
    bool has_plan() const { return best_ >= 0; }
    std::int64_t cost() const { return nodes_[best_].cost; }
    std::span<const std::uint8_t> actions(std::size_t robot) const { return stored(best_tracks_[robot]); }

private:
    struct Constraint {
        int robot = -1;
        Constraints::Ban ban{0, 0, 0};
        int earliest = 0, latest = forever;
    };
    // A path, and the node whose constraints it was planned under: it is one of the shortest that obey them.
    struct Track {
        int robot, basis;
        std::size_t begin;
        int length;
    };
    struct Change {
        int robot, track;
    };
    struct Node {
        int parent, cost, bound, conflicts;  // bound: no plan below this node costs less
        bool has_heuristic;                        // whether the bound knows of the dependent pairs
        std::array<Constraint, 2> constraints;
        std::size_t first_change;
        int changes;
    };
    struct Conflict {
        int first, second, cell, time;  // for swaps, `first` moves to `cell`
        int action;                     // of `first` in a swap, else idle
        bool at_rest;                   // the first has arrived before
    };
    struct Open {
        int bound, conflicts, id;
    };
    struct CachedDiagram {
        int robot = -1, basis = -1;
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
    const Conflict& choose(Budget& budget);
    int rank(const Conflict& conflict, Budget& budget);
    int branch(int id, const std::array<Constraint, 2>& constraints, Budget& budget);
    bool trespasses(int robot, int goal, int since) const;
    bool replan(int child, int robot, Budget& budget);
    void keep(int id);
    bool depend(int first, int second, Budget& budget);
    const DecisionDiagram& diagram(int robot, int basis, const DecisionDiagram* other, Budget& budget);
    void collect_constraints(int robot, int basis);
    int store(int robot, int basis, std::span<const std::uint8_t> actions);
    std::span<const std::uint8_t> stored(int track) const;
    PathView view(int track) const;

    const Problem* problem_ = nullptr;  // during a search
    std::size_t num_robots_ = 0;
    std::vector<Node> nodes_;
    std::vector<Change> changes_;
    std::vector<Track> tracks_;
    std::vector<std::uint8_t> actions_;
    std::vector<Open> open_;  // a heap
    std::vector<int> root_tracks_, loaded_, wanted_, best_tracks_;
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
