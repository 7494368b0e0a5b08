// Enhanced conflict-based search: many robots, a cost within a factor w of the optimum.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/lazy_constraints.hpp"
#include "experts/native/neighbourhood_search.hpp"
#include "experts/native/open_list.hpp"
#include "experts/native/problem.hpp"
#include "experts/native/proving_search.hpp"
#include "experts/native/space_time_search.hpp"
#include "experts/native/traffic.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

struct EcbsOptions {
    double w;                // cost <= w * lower bound
    std::size_t node_limit;  // high-level nodes to generate at most
    std::uint64_t seed;      // shuffles the order in which the root plans the robots
    bool hard_cases = true;  // false: give up, with `node_limit`, on what a few expansions do not solve
};

// The search and its memory, which the next search of the same thread reuses.
//
// Barer, Sharon, Stern and Felner 2014, "Suboptimal variants of the conflict-based search algorithm", with the whole
// of w spent on the high level: paths are optimal under their constraints, so a node's cost bounds its subtree from
// below, and makespans stay short. Conflicts are bypassed where that is free (Boyarski et al. 2015). What that does not
// solve in a few expansions goes to a neighbourhood search and to LaCAM, for a plan, and to a proving search, for a
// bound.
class Ecbs {
public:
    // A search that ends at a limit keeps its incumbent, the cheapest plan that it found, whose cost is above w times the
    // lower bound then: has_plan() holds for it, too.
    Status solve(const Problem& problem, const EcbsOptions& options, Budget& budget);

    // The plan of the last search, if any: each robot's actions until it arrives.
    std::span<const std::uint8_t> actions(std::size_t robot) const {
        switch (found_by_) {
            case FoundBy::proof: return hard_->proving.actions(robot);
            case FoundBy::lacam: return hard_->crowd_plan.actions(robot);
            case FoundBy::ecbs: return stored(loaded_[robot]);
            default: return hard_->neighbourhoods.actions(robot);
        }
    }
    bool has_plan() const { return found_by_ != FoundBy::none; }
    FoundBy found_by() const { return found_by_; }
    int cost() const { return cost_; }
    int lower_bound() const { return lower_bound_; }
    std::size_t expansions() const { return expansions_ + (proves_ ? hard_->proving.expansions() : 0); }
    // Nodes of all searches, the joint states of LaCAM included.
    std::size_t generated() const {
        const std::size_t states = hard_ && hard_->lacam ? hard_->lacam->generated() : 0;
        return nodes_.size() + (proves_ ? hard_->proving.generated() : 0) + states;
    }

private:
    // Robot `robot` must not arrive in `cell` at `time` by any of `actions` (a bit each).
    struct Constraint {
        int robot, cell, time;
        std::uint8_t actions;
    };
    // A node differs from its parent in one constraint (none if it bypasses a conflict) and the path of one robot.
    struct Node {
        int parent, robot, path, cost, conflicts;
        Constraint constraint;
    };
    struct StoredPath {
        std::size_t begin;
        int length;
    };
    struct Conflict {
        Constraint first, second;  // one of the two must hold
    };
    struct Occupant {
        std::uint64_t stamp;
        int robot;
    };

    struct HardCases {
        NeighbourhoodSearch neighbourhoods;
        ProvingSearch proving;
        std::optional<Lacam> lacam;  // of this problem, once it was asked
        JointPlan crowd_plan;        // its plan
        FoundBy plan_of_neighbourhoods = FoundBy::repair;

        std::size_t lacam_expansions() const { return lacam ? lacam->expansions() : 0; }
    };

    Status search(const EcbsOptions& options, Budget& budget);
    bool plan_root(double w, std::uint64_t seed, Budget& budget);
    bool replan_root(Node& root, Budget& budget);
    Status solve_hard_case(int id, const EcbsOptions& options, Budget& budget);
    std::optional<Status> continue_lacam(std::size_t expansions, const EcbsOptions& options, Budget& budget);
    Status finish(FoundBy solver, std::int64_t cost);
    Status end_at(Status limit, double w);
    Journey journey(int robot, int earliest) const;
    void expand(int id, Budget& budget);
    void load(int id);
    Conflict first_conflict();
    std::optional<Node> replan(int id, const Constraint& constraint, Budget& budget);
    int store(const std::vector<std::uint8_t>& actions);
    std::span<const std::uint8_t> stored(int path) const;
    PathView view(int robot, int path) const;
    void open(const Node& node);

    const Problem* problem_ = nullptr;  // during a search
    std::size_t num_robots_ = 0;
    std::vector<Node> nodes_;
    std::vector<StoredPath> paths_;
    std::vector<std::uint8_t> actions_;  // of all paths, one after the other
    OpenList open_;
    SpaceTimeSearch search_;
    std::unique_ptr<HardCases> hard_;  // made for the first hard case
    FoundBy found_by_ = FoundBy::none;
    int best_node_ = -1;    // the cheapest node without conflicts
    bool repairs_ = false;  // whether the neighbourhood search is of this problem
    bool proves_ = false;   // whether the proving search is
    Traffic traffic_;
    std::vector<int> loaded_;  // the path of each robot that is in the traffic now
    std::vector<int> root_paths_, wanted_, order_;
    std::vector<int> cells_, previous_cells_;
    std::vector<Occupant> occupants_, previous_occupants_;
    std::uint64_t stamp_ = 0;
    int cost_ = 0, lower_bound_ = 0;
    std::size_t expansions_ = 0;
};

}  // namespace mapf
