#include "experts/native/lazy_constraints.hpp"

#include <algorithm>
#include <numeric>
#include <utility>

namespace mapf {

namespace {

constexpr int none = -1;
constexpr std::size_t patience = 500, patience_a_step = 4;  // expansions of a turn: of any, and for the longest way

// The distances that swaps compare; they are computed on demand.
struct GuidanceSwaps {
    static constexpr bool on = true;
    std::span<const int> goals;
    std::vector<Guidance>& guidance;

    bool nearer(int robot, int from, int to) const { return guidance[robot].detour(from, to) < 0; }
};

// The member number `index` >= 1 of the sequence 1 1 2 1 1 2 4 1 1 2 1 1 2 4 8 ...
std::size_t luby(std::size_t index) {
    std::size_t power = 1;
    while (2 * power - 1 < index) power *= 2;
    while (2 * power - 1 != index) {
        index -= power - 1;
        for (power = 1; 2 * power - 1 < index;) power *= 2;
    }
    return power;
}

}  // namespace

Lacam::Lacam(const Grid& grid, std::span<const int> starts, std::span<const int> goals, std::uint64_t seed)
    : grid_(grid), num_robots_(starts.size()), seed_(seed), step_(grid.layout), forward_{starts, goals, {}},
      backward_{goals, starts, {}}, complete_(forward_, seed), probe_(forward_, seed), new_state_(starts.size()),
      preferences_(starts.size() * num_actions), actions_(starts.size()) {}

Status Lacam::run(const Limits& limits, Budget& budget) {
    if (!compute_distances(forward_, budget)) return Status::time_limit;
    while (true) {
        if (expansions_ >= turn_end_ && !begin_turn(budget)) return Status::time_limit;
        const auto others = generated() - tree_->nodes.size();
        const auto node_limit = limits.nodes - std::min(limits.nodes, others);
        const auto status = search(std::min(turn_end_, limits.expansions), node_limit, budget);
        if (status) return *status;
        if (expansions_ >= limits.expansions) return Status::node_limit;
    }
}

// Computes the robots' distances; returns false if the budget was spent first.
bool Lacam::compute_distances(Direction& direction, Budget& budget) {
    auto& guidance = direction.guidance;
    while (guidance.size() < num_robots_) {
        const auto robot = guidance.size();
        const int distance = guidance.emplace_back(grid_, direction.starts[robot], direction.goals[robot]).distance();
        if (&direction == &forward_) lower_bound_ += distance;
        longest_ = std::max(longest_, static_cast<std::size_t>(distance));
        if (budget.look()) return false;
    }
    return true;
}

// Begins the next turn: of the complete search, then of a new probe, then of a new probe from the goals. Returns false if
// the budget was spent first.
bool Lacam::begin_turn(Budget& budget) {
    const auto round = turns_ / 3, who = turns_ % 3;
    auto& direction = who == 2 ? backward_ : forward_;
    if (!compute_distances(direction, budget)) return false;
    tree_ = who == 0 ? &complete_ : &probe_;
    if (who > 0) {
        dropped_ += probe_.nodes.size();
        probe_ = Tree(direction, mix(seed_, turns_));
    }
    if (tree_->nodes.empty()) add_root(who == 0);
    turn_end_ = expansions_ + luby(round + 1) * (patience + patience_a_step * longest_);
    ++turns_;
    return true;
}

// Adds the starts to the tree as its root.
void Lacam::add_root(bool longest_first) {
    const auto& [starts, goals, guidance] = *tree_->direction;
    std::vector<int> order(num_robots_);
    std::iota(order.begin(), order.end(), 0);
    if (longest_first)
        std::ranges::stable_sort(order, std::ranges::greater{}, [&](int robot) { return guidance[robot].distance(); });
    else
        tree_->random.shuffle_front(order, static_cast<int>(num_robots_));
    new_state_.assign(starts.begin(), starts.end());
    tree_->open.push_back(add(none, std::move(order)));
}

// Continues the current tree; returns nothing if the expansions have reached their limit.
std::optional<Status> Lacam::search(std::size_t expansion_limit, std::size_t node_limit, Budget& budget) {
    auto& [direction, nodes, states, known, open, random, goal_node] = *tree_;
    while (!open.empty()) {
        // 1. The newest node of OPEN: the search is depth first.
        const int id = open.back();
        if (std::ranges::equal(state(*tree_, id), direction->goals)) {
            goal_node = id;
            return Status::solved;
        }
        if (budget.look()) return Status::time_limit;
        if (expansions_ >= expansion_limit) return std::nullopt;
        // 2. Low level: take the node's next constraint and append that constraint's children.
        auto& node = nodes[id];
        if (node.next_constraint == node.constraints.size()) {
            open.pop_back();
            continue;
        }
        const auto which = static_cast<int>(node.next_constraint++);
        const auto constraint = node.constraints[static_cast<std::size_t>(which)];
        add_constraints(id, which);
        // 3. Configuration generator: PIBT under the constraint.
        ++expansions_;
        if (!generate_successor(id, constraint)) continue;
        // 4. A known configuration goes to the top of OPEN again; a new one becomes a node.
        if (const int old = find_node(new_state_); old != none) {
            open.push_back(old);
            continue;
        }
        if (nodes.size() >= node_limit) return Status::node_limit;
        open.push_back(add(id, node.order));
    }
    return Status::infeasible;
}

// Adds new_state_ as a node; robots on their goals come last in its order.
int Lacam::add(int parent, std::vector<int> order) {
    const int id = static_cast<int>(tree_->nodes.size());
    const auto goals = tree_->direction->goals;
    std::ranges::stable_partition(order, [&](int robot) { return new_state_[robot] != goals[robot]; });
    tree_->states.insert(tree_->states.end(), new_state_.begin(), new_state_.end());
    tree_->known.emplace(hash(new_state_), id);
    tree_->nodes.push_back({parent, std::move(order), {{none, none, 0}}});
    return id;
}

int Lacam::find_node(std::span<const int> cells) const {
    const auto [begin, end] = tree_->known.equal_range(hash(cells));
    for (auto at = begin; at != end; ++at)
        if (std::ranges::equal(state(*tree_, at->second), cells)) return at->second;
    return none;
}

// Appends the children of a constraint: one for each cell that the next robot of the node's order can move to.
void Lacam::add_constraints(int id, int which) {
    auto& node = tree_->nodes[id];
    const int depth = node.constraints[static_cast<std::size_t>(which)].depth;
    if (depth == static_cast<int>(num_robots_)) return;
    const int cell = state(*tree_, id)[node.order[depth]];
    std::vector<int> actions(num_actions);
    std::iota(actions.begin(), actions.end(), 0);
    tree_->random.shuffle_front(actions, num_actions);
    for (const int action : actions) {
        const int target = cell + grid_.layout.steps()[action];
        if (!grid_.blocked[target]) node.constraints.push_back({which, target, depth + 1});
    }
}

// Writes the configuration that PIBT generates from the node under the constraint to new_state_. Returns false if the
// constraint is not feasible.
bool Lacam::generate_successor(int id, const Constraint& constraint) {
    const auto steps = grid_.layout.steps();
    const auto& node = tree_->nodes[id];
    const auto cells = state(*tree_, id);
    for (std::size_t robot = 0; robot < num_robots_; ++robot)
        prefer(static_cast<int>(robot), cells[robot], &preferences_[robot * num_actions]);
    std::ranges::fill(actions_, PibtStep<>::undecided);
    for (auto at = constraint; at.depth > 0; at = node.constraints[static_cast<std::size_t>(at.parent)]) {
        const int robot = node.order[at.depth - 1];
        const auto action = std::ranges::find(steps, at.cell - cells[robot]) - steps.begin();
        actions_[robot] = static_cast<std::uint8_t>(action);
    }
    const GuidanceSwaps swaps{tree_->direction->goals, tree_->direction->guidance};
    if (!step_.complete(grid_.blocked.data(), cells, node.order, preferences_, actions_, swaps)) return false;
    for (std::size_t robot = 0; robot < num_robots_; ++robot)
        new_state_[robot] = cells[robot] + steps[actions_[robot]];
    return true;
}

// Writes the five actions in order of preference: nearest to the goal first, ties in random order.
void Lacam::prefer(int robot, int cell, std::uint8_t* preferences) {
    if (cell == tree_->direction->goals[robot]) {
        const int first = tree_->random.below(idle);
        preferences[0] = idle;
        for (int rank = 0; rank < idle; ++rank) preferences[rank + 1] = static_cast<std::uint8_t>((first + rank) % idle);
        return;
    }
    const auto steps = grid_.layout.steps();
    std::array<int, num_actions> keys{};
    int draw = tree_->random.below(1 << 3 * num_actions);
    for (int action = 0; action < num_actions; ++action, draw >>= 3) {
        const int next = cell + steps[action];
        const bool may_move = action != idle && !grid_.blocked[next];
        const int detour = may_move ? tree_->direction->guidance[robot].detour(cell, next) : 0;
        keys[action] = ((detour + 1) * 8 + draw % 8) * 8 + action;
    }
    std::ranges::sort(keys);
    for (int rank = 0; rank < num_actions; ++rank) preferences[rank] = static_cast<std::uint8_t>(keys[rank] % 8);
}

std::uint64_t Lacam::hash(std::span<const int> cells) const {
    std::uint64_t value = 0;
    for (const int cell : cells) value = (value ^ static_cast<std::uint64_t>(cell)) * 0x9e3779b97f4a7c15ull;
    return value ^ value >> 32;
}

JointPlan Lacam::plan() const {
    std::vector<int> nodes;
    for (int at = tree_->goal_node; at != none; at = tree_->nodes[at].parent) nodes.push_back(at);
    if (tree_->direction == &forward_) std::ranges::reverse(nodes);
    const auto steps = grid_.layout.steps();
    JointPlan plan{std::vector<std::vector<std::uint8_t>>(num_robots_)};
    for (std::size_t robot = 0; robot < num_robots_; ++robot) {
        auto& actions = plan.of_robot[robot];
        for (std::size_t time = 1; time < nodes.size(); ++time) {
            const int step = state(*tree_, nodes[time])[robot] - state(*tree_, nodes[time - 1])[robot];
            actions.push_back(static_cast<std::uint8_t>(std::ranges::find(steps, step) - steps.begin()));
        }
        while (!actions.empty() && actions.back() == idle) actions.pop_back();
    }
    return plan;
}

}  // namespace mapf
