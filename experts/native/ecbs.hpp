// Enhanced conflict-based search: many robots, a cost within a factor w of the optimum.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
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
};

// The search and its memory, which the next search of the same thread reuses.
//
// Barer, Sharon, Stern and Felner 2014, "Suboptimal variants of the conflict-based search algorithm", with the whole
// of w spent on the high level: paths are optimal under their constraints, so a node's cost bounds its subtree from
// below, and makespans stay short. Conflicts are bypassed where that is free (Boyarski et al. 2015). What that does not
// solve in a few expansions goes to a neighbourhood search, for a plan, and to a proving search, for a bound.
class Ecbs {
public:
    Status solve(const Problem& problem, const EcbsOptions& options, Budget& budget);

    // Of the last search. Each robot's actions until it arrives, if it was solved.
    std::span<const std::uint8_t> actions(std::size_t robot) const {
        switch (author_) {
            case Author::repair: return hard_->neighbourhoods.actions(robot);
            case Author::proof: return hard_->proving.actions(robot);
            default: return stored(loaded_[robot]);
        }
    }
    int cost() const { return cost_; }
    int lower_bound() const { return lower_bound_; }
    std::size_t expansions() const { return expansions_ + (proves_ ? hard_->proving.expansions() : 0); }
    std::size_t generated() const { return nodes_.size() + (proves_ ? hard_->proving.generated() : 0); }

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
    };

    bool plan_root(double w, std::uint64_t seed, Budget& budget);
    bool untangle(Node& root, Budget& budget);
    enum class Author : std::uint8_t { focal, repair, proof };

    Status persist(int id, const EcbsOptions& options, Budget& budget);
    Status finish(Author author, std::int64_t cost);
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
    Author author_ = Author::focal;  // of the solution
    bool proves_ = false;  // whether the proving search is of this problem
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
