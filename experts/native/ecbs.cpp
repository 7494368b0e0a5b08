#include "experts/native/ecbs.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>

#include "experts/native/corridor.hpp"
#include "experts/native/improvement.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

namespace {

constexpr int none = -1;
constexpr std::size_t few_expansions = 32;         // before other means are tried, for w > 1
constexpr std::size_t few_expansions_optimal = 8;  // and for w = 1
constexpr int few_conflicts = 20;                  // with more of them in the root, other means are tried at once
constexpr int many_conflicts = 60;                 // with more of them the root is not untangled
constexpr int first_effort = 64;                   // rounds and nodes of the first turn; later turns have twice as many
constexpr std::size_t first_lacam_expansions = 4096;  // of LaCAM's first turn
constexpr std::size_t lacam_growth = 8;               // factor from one turn to the next

}  // namespace

Status Ecbs::solve(const Problem& problem, const EcbsOptions& options, Budget& budget) {
    problem_ = &problem;
    num_robots_ = problem.starts.size();
    expansions_ = 0;
    cost_ = lower_bound_ = 0;
    found_by_ = FoundBy::none;
    best_node_ = none;
    repairs_ = proves_ = false;
    if (hard_) hard_->lacam.reset();
    nodes_.clear();
    paths_.clear();
    actions_.clear();
    for (std::size_t robot = 0; robot < num_robots_; ++robot)
        lower_bound_ += problem.distances.to_goal_of(robot)[problem.starts[robot]];
    const auto status = search(options, budget);
    return status == Status::node_limit || status == Status::time_limit ? end_at(status, options.w) : status;
}

Status Ecbs::search(const EcbsOptions& options, Budget& budget) {
    if (!plan_root(options.w, options.seed, budget)) return Status::time_limit;
    const auto patience = options.w <= 1                         ? few_expansions_optimal
                          : nodes_[0].conflicts > few_conflicts ? 1
                                                                : few_expansions;
    open_.reset(options.w, nodes_[0].cost);
    open_.push(0, nodes_[0].cost, nodes_[0].conflicts);
    while (!open_.empty()) {
        open_.raise_lower_bound();
        lower_bound_ = open_.lower_bound();
        const int id = open_.pop();
        if (nodes_[id].conflicts == 0) {
            load(id);
            return finish(FoundBy::ecbs, nodes_[id].cost);
        }
        if (expansions_ == patience || nodes_.size() >= options.node_limit)
            return options.hard_cases ? solve_hard_case(id, options, budget) : Status::node_limit;
        ++expansions_;
        expand(id, budget);
        if (budget.look()) return Status::time_limit;
    }
    return Status::infeasible;
}

// Plans the robots one after the other, each around those before it where that costs nothing.
bool Ecbs::plan_root(double w, std::uint64_t seed, Budget& budget) {
    const auto cells = problem_->grid.blocked.size();
    if (occupants_.size() < cells) {
        occupants_.resize(cells);
        previous_occupants_.resize(cells);
    }
    traffic_.reset(problem_->grid.layout);
    order_.resize(num_robots_);
    std::iota(order_.begin(), order_.end(), 0);
    Random(seed).shuffle_front(order_, static_cast<int>(num_robots_));
    loaded_.assign(num_robots_, none);
    Node root{none, none, none, 0, 0, {none, none, none, 0}};
    for (const int robot : order_) {
        if (!search_.run(problem_->grid.layout, traffic_, journey(robot, 0), budget)) return false;
        loaded_[robot] = store(search_.actions());
        traffic_.add(view(robot, loaded_[robot]));
        root.cost += paths_.back().length;
        root.conflicts += search_.conflicts();
    }
    const bool crowded = w > 1 && root.conflicts > many_conflicts;  // left to the neighbourhood search
    for (int before = root.conflicts + 1; !crowded && 0 < root.conflicts && root.conflicts < before;) {
        before = root.conflicts;
        if (!replan_root(root, budget)) return false;
    }
    root_paths_ = loaded_;
    nodes_.push_back(root);
    return true;
}

// Solves what a search of a few nodes did not: large neighbourhood search for a plan (from node `id` or from LaCAM's
// plan) takes turns with best-first search for a bound that proves the plan good enough.
Status Ecbs::solve_hard_case(int id, const EcbsOptions& options, Budget& budget) {
    if (order_forbids_solution(problem_->grid, problem_->starts, problem_->goals)) return Status::infeasible;
    if (!hard_) hard_ = std::make_unique<HardCases>();
    auto& neighbourhoods = hard_->neighbourhoods;
    auto& proving = hard_->proving;
    const auto path_of = [&](std::size_t robot) { return stored(loaded_[robot]); };
    const bool needs_optimum = options.w <= 1;
    if (!needs_optimum) {
        load(id);
        neighbourhoods.begin(*problem_, options.seed, path_of);
        hard_->plan_of_neighbourhoods = FoundBy::repair;
        repairs_ = true;
    }
    const auto nodes_left = [&] {
        return options.node_limit - std::min(options.node_limit, nodes_.size() + (proves_ ? proving.generated() : 0));
    };
    auto lacam_turn = first_lacam_expansions;
    for (int effort = first_effort;; effort += effort, lacam_turn *= lacam_growth) {
        std::int64_t known = std::numeric_limits<std::int64_t>::max();
        if (!needs_optimum) {
            // Repair: neighbourhood search removes the plan's conflicts, then reduces its cost.
            const auto target = cost_limit(options.w, lower_bound_);
            if (neighbourhoods.run(target, effort, budget))
                return finish(hard_->plan_of_neighbourhoods, neighbourhoods.cost());
            // Complete search: LaCAM's plan is the incumbent if it is the cheapest so far.
            const auto most = hard_->lacam_expansions() + lacam_turn;
            if (const auto ended = continue_lacam(most, options, budget)) return *ended;
            if (neighbourhoods.feasible()) known = neighbourhoods.cost();
        }
        // Proof: raise the lower bound. The larger w is, the less that helps.
        if (!proves_) {
            load(0);
            proving.begin(*problem_, path_of);
            proves_ = true;
        }
        const auto share = static_cast<std::size_t>(effort / std::min(1 + 4 * (options.w - 1), 16.0)) + 1;
        const auto turn = needs_optimum ? nodes_left() : std::min(nodes_left(), share);
        const auto outcome = proving.run(options.w, known, proving.generated() + turn, budget);
        lower_bound_ = std::max(lower_bound_, static_cast<int>(proving.lower_bound()));
        if (outcome == ProvingSearch::Outcome::infeasible) return Status::infeasible;
        if (outcome == ProvingSearch::Outcome::proved) {
            const bool own = proving.has_plan() && proving.cost() <= known;
            return finish(own ? FoundBy::proof : hard_->plan_of_neighbourhoods, own ? proving.cost() : known);
        }
        if (budget.look()) return Status::time_limit;
        if (nodes_left() > 0) continue;
        if (needs_optimum) return Status::node_limit;
        const auto most = Lacam::limits_of(options.node_limit).expansions;
        return continue_lacam(most, options, budget).value_or(Status::node_limit);
    }
}

// Continues LaCAM, up to `expansions` in all, unless it has a plan. Its plan ends the search if it is good enough; if it
// is cheaper than the plan of the neighbourhood search, that continues from it.
std::optional<Status> Ecbs::continue_lacam(std::size_t expansions, const EcbsOptions& options, Budget& budget) {
    auto& [neighbourhoods, proving, lacam, plan, plan_of_neighbourhoods] = *hard_;
    if (!lacam) {
        lacam.emplace(problem_->grid, problem_->starts, problem_->goals, options.seed);
        plan = {};
    }
    if (!plan.of_robot.empty()) return std::nullopt;
    const auto limits = Lacam::limits_of(options.node_limit);
    switch (lacam->run({limits.nodes, std::min(limits.expansions, expansions)}, budget)) {
        case Status::solved: break;
        case Status::infeasible: return Status::infeasible;
        default: return std::nullopt;
    }
    plan = lacam->plan();
    const auto target = cost_limit(options.w, lower_bound_);
    if (plan.cost() <= target) return finish(FoundBy::lacam, plan.cost());
    replan_tails(*problem_, target, options.seed, plan, budget);
    if (neighbourhoods.feasible() && neighbourhoods.cost() <= plan.cost()) return std::nullopt;
    neighbourhoods.begin(*problem_, options.seed, [&](std::size_t robot) { return plan.actions(robot); });
    plan_of_neighbourhoods = FoundBy::improvement;
    return std::nullopt;
}

Status Ecbs::finish(FoundBy solver, std::int64_t cost) {
    found_by_ = solver;
    cost_ = static_cast<int>(cost);
    return Status::solved;
}

// Ends with the cheapest plan of all searches, if there is one. That plan can be within the bound: a limit may cut a
// search off after its last plan or bound was found and before the two were compared.
Status Ecbs::end_at(Status limit, double w) {
    auto best = std::numeric_limits<std::int64_t>::max();
    const auto consider = [&](FoundBy solver, std::int64_t cost) {
        if (cost >= best) return;
        best = cost;
        finish(solver, cost);
    };
    if (best_node_ != none) consider(FoundBy::ecbs, nodes_[best_node_].cost);
    if (repairs_ && hard_->neighbourhoods.feasible())
        consider(hard_->plan_of_neighbourhoods, hard_->neighbourhoods.cost());
    if (proves_ && hard_->proving.has_plan()) consider(FoundBy::proof, hard_->proving.cost());
    if (found_by_ == FoundBy::ecbs) load(best_node_);
    return has_plan() && best <= cost_limit(w, lower_bound_) ? Status::solved : limit;
}

// Replans each robot in conflict around the paths of all others; no path becomes longer.
bool Ecbs::replan_root(Node& root, Budget& budget) {
    for (const int robot : order_) {
        const auto old_path = view(robot, loaded_[robot]);
        const int conflicts = traffic_.conflicts(old_path) - old_path.arrival_time();  // it meets itself at every step
        if (conflicts == 0) continue;
        traffic_.remove(old_path);
        if (!search_.run(problem_->grid.layout, traffic_, journey(robot, 0), budget)) return false;
        root.conflicts += search_.conflicts() - conflicts;
        loaded_[robot] = store(search_.actions());
        traffic_.add(view(robot, loaded_[robot]));
    }
    return true;
}

Journey Ecbs::journey(int robot, int earliest) const {
    return {problem_->starts[robot], problem_->goals[robot], problem_->distances.to_goal_of(robot), earliest};
}

// Splits on a conflict: two children, or one that bypasses it at the same cost.
void Ecbs::expand(int id, Budget& budget) {
    load(id);
    const auto conflict = first_conflict();
    std::array<std::optional<Node>, 2> children;
    for (int side = 0; side < 2; ++side) {
        auto& child = children[side];
        child = replan(id, side == 0 ? conflict.first : conflict.second, budget);
        if (!child || child->cost > nodes_[id].cost || child->conflicts >= nodes_[id].conflicts) continue;
        child->constraint.robot = none;
        open(*child);
        return;
    }
    for (const auto& child : children)
        if (child) open(*child);
}

void Ecbs::open(const Node& node) {
    const int id = static_cast<int>(nodes_.size());
    nodes_.push_back(node);
    if (node.conflicts == 0 && (best_node_ == none || node.cost < nodes_[best_node_].cost)) best_node_ = id;
    open_.push(id, node.cost, node.conflicts);
}

// Loads the paths of node `id` into the traffic; paths that stay the same are not touched.
void Ecbs::load(int id) {
    if (traffic_.is_sparse()) {
        traffic_.reset(problem_->grid.layout);
        loaded_.assign(num_robots_, none);
    }
    wanted_.assign(num_robots_, none);
    for (int at = id; nodes_[at].parent != none; at = nodes_[at].parent)
        if (wanted_[nodes_[at].robot] == none) wanted_[nodes_[at].robot] = nodes_[at].path;
    for (std::size_t robot = 0; robot < num_robots_; ++robot) {
        const int path = wanted_[robot] == none ? root_paths_[robot] : wanted_[robot];
        if (path == loaded_[robot]) continue;
        if (loaded_[robot] != none) traffic_.remove(view(static_cast<int>(robot), loaded_[robot]));
        traffic_.add(view(static_cast<int>(robot), path));
        loaded_[robot] = path;
    }
}

// Returns the earliest conflict of the loaded paths, which have at least one.
Ecbs::Conflict Ecbs::first_conflict() {
    const auto steps = problem_->grid.layout.steps();
    cells_.assign(problem_->starts.begin(), problem_->starts.end());
    ++stamp_;
    for (std::size_t robot = 0; robot < num_robots_; ++robot)
        occupants_[cells_[robot]] = {stamp_, static_cast<int>(robot)};
    for (int time = 1; time <= traffic_.horizon(); ++time) {
        previous_cells_ = cells_;
        std::swap(previous_occupants_, occupants_);
        ++stamp_;
        for (int robot = 0; robot < static_cast<int>(num_robots_); ++robot) {
            const auto actions = view(robot, loaded_[robot]).actions;
            if (time <= static_cast<int>(actions.size())) cells_[robot] += steps[actions[time - 1]];
            auto& occupant = occupants_[cells_[robot]];
            if (occupant.stamp == stamp_)
                return {{occupant.robot, cells_[robot], time, all_actions}, {robot, cells_[robot], time, all_actions}};
            occupant = {stamp_, robot};
        }
        for (int robot = 0; robot < static_cast<int>(num_robots_); ++robot) {
            const int from = previous_cells_[robot], to = cells_[robot];
            const auto& before = previous_occupants_[to];
            if (from == to || before.stamp != stamp_ - 1 || cells_[before.robot] != from) continue;
            const int action = view(robot, loaded_[robot]).actions[time - 1];
            return {{robot, to, time, static_cast<std::uint8_t>(1 << action)},
                    {before.robot, from, time, static_cast<std::uint8_t>(1 << reversed(action))}};
        }
    }
    throw std::logic_error("conflicts were counted, but the paths have none: please report this as a bug of experts");
}

// Returns the child of the loaded node `id` with one more constraint, if its robot has a path.
std::optional<Ecbs::Node> Ecbs::replan(int id, const Constraint& constraint, Budget& budget) {
    const int robot = constraint.robot;
    const int goal = problem_->goals[robot];
    const auto old_path = view(robot, loaded_[robot]);
    int earliest = 0;
    const auto forbid = [&](const Constraint& c) {
        traffic_.forbid(c.cell, c.time, c.actions);
        if (c.cell == goal && c.actions == all_actions) earliest = std::max(earliest, c.time + 1);
    };
    traffic_.remove(old_path);
    Node child = nodes_[id];
    child.conflicts -= traffic_.conflicts(old_path);
    forbid(constraint);
    for (int at = id; at != none; at = nodes_[at].parent)
        if (nodes_[at].constraint.robot == robot) forbid(nodes_[at].constraint);
    const bool found = search_.run(problem_->grid.layout, traffic_, journey(robot, earliest), budget);
    traffic_.allow(constraint.cell, constraint.time);
    for (int at = id; at != none; at = nodes_[at].parent)
        if (nodes_[at].constraint.robot == robot) traffic_.allow(nodes_[at].constraint.cell, nodes_[at].constraint.time);
    traffic_.add(old_path);
    if (!found) return std::nullopt;
    child.parent = id;
    child.robot = robot;
    child.cost += static_cast<int>(search_.actions().size()) - old_path.arrival_time();
    child.conflicts += search_.conflicts();
    child.constraint = constraint;
    child.path = store(search_.actions());
    return child;
}

int Ecbs::store(const std::vector<std::uint8_t>& actions) {
    paths_.push_back({actions_.size(), static_cast<int>(actions.size())});
    actions_.insert(actions_.end(), actions.begin(), actions.end());
    return static_cast<int>(paths_.size()) - 1;
}

std::span<const std::uint8_t> Ecbs::stored(int path) const {
    return std::span(actions_).subspan(paths_[path].begin, static_cast<std::size_t>(paths_[path].length));
}

PathView Ecbs::view(int robot, int path) const {
    return {problem_->starts[robot], stored(path)};
}

}  // namespace mapf
