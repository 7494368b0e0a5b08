#include "experts/native/proving_search.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace mapf {

namespace {

constexpr int none = -1;
constexpr std::size_t cached_diagrams = 1024, cached_pairs = 1 << 14;

std::size_t mixed(std::size_t a, std::size_t b) { return (a * 0x9E3779B97F4A7C15ull) ^ (b * 0xC2B2AE3D27D4EB4Full) >> 7; }

}  // namespace

void ProvingSearch::reset(const Problem& problem) {
    problem_ = &problem;
    num_robots_ = problem.starts.size();
    nodes_.clear();
    changes_.clear();
    paths_.clear();
    actions_.clear();
    open_.clear();
    root_paths_.assign(num_robots_, none);
    loaded_.assign(num_robots_, none);
    best_ = none;
    lower_bound_ = 0;
    expansions_ = 0;
    traffic_.reset(problem.grid.layout);
    diagrams_.resize(cached_diagrams);
    pairs_.assign(cached_pairs, {});
    for (auto& cached : diagrams_) cached.robot = none;
    const auto cells = problem.grid.blocked.size();
    occupant_.assign(cells, none);
    previous_occupant_.assign(cells, none);
}

void ProvingSearch::open_root() {
    Node root{none, 0, 0, 0, false, {}, 0, 0};
    for (std::size_t robot = 0; robot < num_robots_; ++robot) {
        const auto path = view(root_paths_[robot]);
        root.cost += path.arrival_time();
        root.conflicts += traffic_.conflicts(path);
        traffic_.add(path);
        loaded_[robot] = root_paths_[robot];
    }
    root.bound = root.cost;
    nodes_.push_back(root);
    insert(0);
}

ProvingSearch::Outcome ProvingSearch::run(double w, std::int64_t known, std::size_t nodes, Budget& budget) {
    const auto proved = [&] {
        const auto limit = cost_limit(w, lower_bound_);
        return known <= limit || (has_plan() && cost() <= limit);
    };
    while (!open_.empty()) {
        // 1. Best first: the lowest f in OPEN is a lower bound on the optimum.
        lower_bound_ = std::max<std::int64_t>(lower_bound_, open_.front().bound);
        if (proved()) return Outcome::proved;
        if (nodes_.size() >= nodes || budget.look()) return Outcome::paused;
        const int id = pop();
        load(id);
        // 2. Conflicts: the first of each pair.
        find_conflicts();
        // 3. DG heuristic, computed when a node is first taken: if it raises f, the node goes back into OPEN.
        if (!nodes_[id].has_heuristic && compute_heuristic(id, budget)) {
            push(id);
            continue;
        }
        // 4. Split: every plan that obeys the node's constraints obeys those of one child.
        ++expansions_;
        expand(id, budget);
        if (budget.look()) {  // children may be missing, so the node stays in OPEN
            push(id);
            return Outcome::paused;
        }
    }
    return Outcome::infeasible;
}

void ProvingSearch::push(int id) {
    open_.push_back({nodes_[id].bound, nodes_[id].conflicts, id});
    std::push_heap(open_.begin(), open_.end(), is_worse);
}

int ProvingSearch::pop() {
    std::pop_heap(open_.begin(), open_.end(), is_worse);
    const int id = open_.back().id;
    open_.pop_back();
    return id;
}

// Loads the paths of node `id` into the traffic; paths that stay the same are not touched.
void ProvingSearch::load(int id) {
    if (traffic_.is_sparse()) {
        traffic_.reset(problem_->grid.layout);
        loaded_.assign(num_robots_, none);
    }
    wanted_.assign(num_robots_, none);
    for (int at = id; at != none; at = nodes_[at].parent)
        for (int i = 0; i < nodes_[at].changes; ++i) {
            const auto& change = changes_[nodes_[at].first_change + static_cast<std::size_t>(i)];
            if (wanted_[change.robot] == none) wanted_[change.robot] = change.path;
        }
    for (std::size_t robot = 0; robot < num_robots_; ++robot) {
        const int path = wanted_[robot] == none ? root_paths_[robot] : wanted_[robot];
        if (path == loaded_[robot]) continue;
        if (loaded_[robot] != none) traffic_.remove(view(loaded_[robot]));
        traffic_.add(view(path));
        loaded_[robot] = path;
    }
}

// Finds the first conflict of each pair of robots, by playing all paths step by step.
void ProvingSearch::find_conflicts() {
    const auto steps = problem_->grid.layout.steps();
    conflicts_.clear();
    cells_.assign(problem_->starts.begin(), problem_->starts.end());
    for (std::size_t robot = 0; robot < num_robots_; ++robot) occupant_[cells_[robot]] = static_cast<int>(robot);
    for (int time = 1; time <= traffic_.horizon(); ++time) {
        previous_cells_ = cells_;
        std::swap(previous_occupant_, occupant_);
        for (int robot = 0; robot < static_cast<int>(num_robots_); ++robot) {
            const auto actions = stored(loaded_[robot]);
            if (time <= static_cast<int>(actions.size())) cells_[robot] += steps[actions[time - 1]];
            int& occupant = occupant_[cells_[robot]];
            if (occupant == none)
                occupant = robot;
            else if (time >= paths_[loaded_[robot]].length)
                add_conflict(robot, occupant, cells_[robot], time, idle);
            else
                add_conflict(occupant, robot, cells_[robot], time, idle);
        }
        for (int robot = 0; robot < static_cast<int>(num_robots_); ++robot) {
            const int other = previous_occupant_[cells_[robot]];
            if (other <= robot || cells_[other] != previous_cells_[robot]) continue;
            add_conflict(robot, other, cells_[robot], time, stored(loaded_[robot])[time - 1]);
        }
        for (const int cell : previous_cells_) previous_occupant_[cell] = none;
    }
    for (const int cell : cells_) occupant_[cell] = none;
}

void ProvingSearch::add_conflict(int first, int second, int cell, int time, int action) {
    for (const auto& known : conflicts_)
        if ((known.first == first && known.second == second) || (known.first == second && known.second == first))
            return;
    const bool at_rest = action == idle && time >= paths_[loaded_[first]].length;
    conflicts_.push_back({first, second, cell, time, action, at_rest});
}

// Adds h to the node's cost; returns true if its bound has grown.
bool ProvingSearch::compute_heuristic(int id, Budget& budget) {
    dependent_.clear();
    // The pairwise dependency graph has an edge for each dependent pair, one of whose robots takes longer: at least as
    // many robots take longer as a minimum vertex cover has.
    for (const auto& conflict : conflicts_)
        if (are_dependent(conflict.first, conflict.second, budget))
            dependent_.emplace_back(conflict.first, conflict.second);
    auto& node = nodes_[id];
    node.has_heuristic = true;
    const int bound = node.cost + cover_.size(dependent_);
    if (bound <= node.bound) return false;
    node.bound = bound;
    return true;
}

void ProvingSearch::expand(int id, Budget& budget) {
    const auto conflict = choose_conflict(budget);
    const int first = conflict.first, second = conflict.second;
    const int first_length = paths_[loaded_[first]].length, second_length = paths_[loaded_[second]].length;
    std::array<std::array<Constraint, 2>, 2> sides;
    if (conflict.at_rest) {
        // Target conflict: the first robot arrives later, or it arrives by then and no other robot visits its goal.
        sides[0][0] = {first, {}, conflict.time + 1, forever};
        sides[1][0] = {first, {}, 0, conflict.time};
    } else if (are_dependent(first, second, budget)) {
        // Dependent pair: the first robot takes longer, or it does not and the second does.
        sides[0][0] = {first, {}, first_length + 1, forever};
        sides[1][0] = {first, {}, 0, first_length};
        sides[1][1] = {second, {}, second_length + 1, forever};
    } else if (conflict.action == idle) {
        // Vertex conflict.
        sides[0][0] = {first, {conflict.cell, conflict.time, all_actions}, 0, forever};
        sides[1][0] = {second, {conflict.cell, conflict.time, all_actions}, 0, forever};
    } else {
        // Swap conflict.
        const int back = problem_->grid.layout.steps()[reversed(conflict.action)];
        sides[0][0] = {first, {conflict.cell, conflict.time, static_cast<std::uint8_t>(1 << conflict.action)}, 0, forever};
        sides[1][0] = {second,
                       {conflict.cell + back, conflict.time, static_cast<std::uint8_t>(1 << reversed(conflict.action))},
                       0,
                       forever};
    }
    std::array<int, 2> children{};
    for (int side = 0; side < 2; ++side) {
        children[side] = make_child(id, sides[side], budget);
        if (children[side] == none) continue;
        auto& child = nodes_[children[side]];
        if (child.changes != 1 || child.cost > nodes_[id].cost || child.conflicts >= nodes_[id].conflicts) continue;
        // Bypass: a path of the same cost with fewer conflicts is adopted without a constraint; the node is not split.
        const auto& change = changes_[child.first_change];
        paths_[change.path].planned_under = paths_[loaded_[change.robot]].planned_under;
        child.constraints = {};
        insert(children[side]);
        return;
    }
    for (const int child : children)
        if (child != none) insert(child);
}

// Prefers dependent pairs, then semi-cardinal conflicts (one robot cannot avoid them), then the earliest.
const ProvingSearch::Conflict& ProvingSearch::choose_conflict(Budget& budget) {
    std::size_t best = 0;
    int best_rank = forever;
    for (std::size_t i = 0; i < conflicts_.size(); ++i) {
        const int own = conflict_rank(conflicts_[i], budget);
        if (own > best_rank || (own == best_rank && conflicts_[i].time >= conflicts_[best].time)) continue;
        best = i;
        best_rank = own;
    }
    if (conflicts_.empty())
        throw std::logic_error("conflicts were counted, but the paths have none: please report this as a bug of experts");
    return conflicts_[best];
}

int ProvingSearch::conflict_rank(const Conflict& conflict, Budget& budget) {
    if (are_dependent(conflict.first, conflict.second, budget)) return conflict.at_rest ? 0 : 1;
    if (conflict.at_rest) return 2;
    for (const int robot : {conflict.first, conflict.second}) {
        const auto& all = diagram(robot, paths_[loaded_[robot]].planned_under, nullptr, budget);
        if (conflict.time > all.length || all.at(conflict.time).size() > 1) continue;
        if (conflict.action == idle || all.at(conflict.time - 1).size() == 1) return 2;
    }
    return 3;
}

// Generates the child of the loaded node `id` with further constraints, and replans the robots that violate them.
// Returns `none` if a robot has no path; the child's number is used up in any case.
int ProvingSearch::make_child(int id, const std::array<Constraint, 2>& constraints, Budget& budget) {
    const int child = static_cast<int>(nodes_.size());
    nodes_.push_back(nodes_[id]);
    auto& node = nodes_.back();
    node.parent = id;
    node.has_heuristic = false;
    node.constraints = constraints;
    node.first_change = changes_.size();
    node.changes = 0;
    bool possible = true;
    for (const auto& [robot, ban, earliest, latest] : constraints) {
        if (robot == none) continue;
        if (earliest > 0 || ban.actions != 0) possible = possible && replan(child, robot, budget);
        if (latest == forever) continue;
        for (int other = 0; other < static_cast<int>(num_robots_); ++other) {
            if (other == robot || (other == constraints[1].robot && constraints[1].earliest > 0)) continue;
            if (visits(other, problem_->goals[robot], latest)) possible = possible && replan(child, other, budget);
        }
    }
    const auto changes = std::span(changes_).subspan(node.first_change);
    for (const auto& change : changes) traffic_.remove(view(change.path));
    for (const auto& change : changes) traffic_.add(view(loaded_[change.robot]));
    node.bound = std::max(node.bound, node.cost);
    return possible ? child : none;
}

// Returns true if the loaded path of `robot` is in the cell `goal` at the time `since` or later.
bool ProvingSearch::visits(int robot, int goal, int since) const {
    const auto path = view(loaded_[robot]);
    int cell = path.start, time = 0;
    for (const int action : path.actions) {
        cell += problem_->grid.layout.steps()[action];
        if (++time >= since && cell == goal) return true;
    }
    return false;
}

// Replaces a robot's path by a shortest path under the child's constraints, with the fewest conflicts among those.
bool ProvingSearch::replan(int child, int robot, Budget& budget) {
    const auto& all = diagram(robot, child, nullptr, budget);
    if (all.length < 0) return false;
    auto& node = nodes_[child];
    const auto old_path = view(loaded_[robot]);
    traffic_.remove(old_path);
    node.conflicts -= traffic_.conflicts(old_path);
    node.conflicts += builder_.best_path(all, traffic_, new_actions_);
    node.cost += all.length - old_path.arrival_time();
    const int path = store(robot, child, new_actions_);
    traffic_.add(view(path));
    changes_.push_back({robot, path});
    ++node.changes;
    return true;
}

// Pushes the node into OPEN; a conflict-free node that is cheaper than the incumbent replaces it.
void ProvingSearch::insert(int id) {
    push(id);
    if (nodes_[id].conflicts > 0 || (best_ != none && nodes_[best_].cost <= nodes_[id].cost)) return;
    load(id);
    best_ = id;
    best_paths_ = loaded_;
}

// Returns true if no two shortest paths of the robots, under the constraints of their loaded paths, are compatible.
bool ProvingSearch::are_dependent(int first, int second, Budget& budget) {
    if (first > second) std::swap(first, second);
    const std::array<int, 4> key{first, paths_[loaded_[first]].planned_under,
                                 second, paths_[loaded_[second]].planned_under};
    auto& cached = pairs_[mixed(mixed(static_cast<std::size_t>(key[0]), static_cast<std::size_t>(key[1])),
                                mixed(static_cast<std::size_t>(key[2]), static_cast<std::size_t>(key[3]))) %
                          pairs_.size()];
    if (cached.key == key) return cached.dependent;
    const auto& one = diagram(first, key[1], nullptr, budget);
    const auto& other = diagram(second, key[3], &one, budget);
    const bool known = one.length >= 0 && other.length >= 0;  // else the budget was spent
    const bool dependent = known && !joint_.compatible(one, other);
    if (known) cached = {key, dependent};
    return dependent;
}

// Returns all shortest paths of the robot under the constraints of node `planned_under`; `other` stays valid.
const DecisionDiagram& ProvingSearch::diagram(int robot, int planned_under, const DecisionDiagram* other,
                                              Budget& budget) {
    auto place = mixed(static_cast<std::size_t>(robot), static_cast<std::size_t>(planned_under)) % diagrams_.size();
    if (&diagrams_[place].diagram == other) place = (place + 1) % diagrams_.size();
    auto& cached = diagrams_[place];
    if (cached.robot == robot && cached.planned_under == planned_under) return cached.diagram;
    collect_constraints(robot, planned_under);
    builder_.build(problem_->grid, problem_->starts[robot], problem_->goals[robot],
                   problem_->distances.to_goal_of(static_cast<std::size_t>(robot)), constraints_, cached.diagram, budget);
    cached.robot = budget.look() ? none : robot;
    cached.planned_under = planned_under;
    return cached.diagram;
}

void ProvingSearch::collect_constraints(int robot, int planned_under) {
    constraints_.clear();
    for (int at = planned_under; at != none; at = nodes_[at].parent)
        for (const auto& constraint : nodes_[at].constraints) {
            if (constraint.robot == none) continue;
            if (constraint.robot != robot) {
                if (constraint.latest != forever)
                    constraints_.closed_cells.push_back({problem_->goals[constraint.robot], constraint.latest});
                continue;
            }
            constraints_.earliest = std::max(constraints_.earliest, constraint.earliest);
            constraints_.latest = std::min(constraints_.latest, constraint.latest);
            if (constraint.ban.actions != 0) constraints_.bans.push_back(constraint.ban);
        }
}

int ProvingSearch::store(int robot, int planned_under, std::span<const std::uint8_t> actions) {
    paths_.push_back({robot, planned_under, actions_.size(), static_cast<int>(actions.size())});
    actions_.insert(actions_.end(), actions.begin(), actions.end());
    return static_cast<int>(paths_.size()) - 1;
}

std::span<const std::uint8_t> ProvingSearch::stored(int path) const {
    return std::span(actions_).subspan(paths_[path].begin, static_cast<std::size_t>(paths_[path].length));
}

PathView ProvingSearch::view(int path) const { return {problem_->starts[paths_[path].robot], stored(path)}; }

}  // namespace mapf
