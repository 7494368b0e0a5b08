#include "experts/native/lacam.hpp"

#include <algorithm>
#include <numeric>

namespace mapf {

namespace {

constexpr int none = -1;

}  // namespace

Lacam::Lacam(const Grid& grid, std::span<const int> starts, std::span<const int> goals, std::uint64_t seed)
    : grid_(grid), starts_(starts), goals_(goals), random_(seed), step_(grid.layout) {
    preferences_.resize(starts.size() * num_actions);
    actions_.resize(starts.size());
}

Status Lacam::run(std::size_t node_limit, Budget& budget) {
    for (std::size_t robot = 0; robot < starts_.size(); ++robot) {
        lower_bound_ += guidance_.emplace_back(grid_, starts_[robot], goals_[robot]).distance();
        if (budget.look()) return Status::time_limit;
    }
    new_state_.assign(starts_.begin(), starts_.end());
    open_.push_back(add(none));
    while (!open_.empty()) {
        const int id = open_.back();
        if (std::ranges::equal(state(id), goals_)) {
            goal_node_ = id;
            return Status::solved;
        }
        if (budget.look()) return Status::time_limit;
        auto& node = nodes_[id];
        if (node.next_constraint == node.constraints.size()) {
            open_.pop_back();
            continue;
        }
        const auto which = static_cast<int>(node.next_constraint++);
        const auto constraint = node.constraints[static_cast<std::size_t>(which)];
        if (constraint.depth < static_cast<int>(starts_.size())) {
            const int cell = state(id)[node.order[constraint.depth]];
            std::vector<int> actions(num_actions);
            std::iota(actions.begin(), actions.end(), 0);
            random_.shuffle_front(actions, num_actions);
            for (const int action : actions) {
                const int target = cell + grid_.layout.steps()[action];
                if (!grid_.blocked[target]) node.constraints.push_back({which, target, constraint.depth + 1});
            }
        }
        ++expansions_;
        if (!make_successor(id, constraint)) continue;
        const int known = find(new_state_);
        if (known != none) {
            open_.push_back(known);
            continue;
        }
        if (nodes_.size() >= node_limit) return Status::node_limit;
        open_.push_back(add(id));
    }
    return Status::infeasible;
}

// Adds new_state_ as a node.
int Lacam::add(int parent) {
    const int id = static_cast<int>(nodes_.size());
    Node node{parent, {}, {{none, none, 0}}};
    if (parent == none) {
        node.order.resize(starts_.size());
        std::iota(node.order.begin(), node.order.end(), 0);
        std::ranges::stable_sort(node.order, std::ranges::greater{},
                                 [&](int robot) { return guidance_[robot].distance(); });
    } else {
        node.order = nodes_[parent].order;
    }
    std::ranges::stable_partition(node.order, [&](int robot) { return new_state_[robot] != goals_[robot]; });
    states_.insert(states_.end(), new_state_.begin(), new_state_.end());
    known_.emplace(hash(new_state_), id);
    nodes_.push_back(std::move(node));
    return id;
}

int Lacam::find(std::span<const int> cells) const {
    const auto [begin, end] = known_.equal_range(hash(cells));
    for (auto at = begin; at != end; ++at)
        if (std::ranges::equal(state(at->second), cells)) return at->second;
    return none;
}

// Writes the joint state that PIBT reaches from `node` under the constraint to new_state_, if it finds one.
bool Lacam::make_successor(int id, const Constraint& constraint) {
    const auto steps = grid_.layout.steps();
    const auto& node = nodes_[id];
    const auto cells = state(id);
    for (std::size_t robot = 0; robot < starts_.size(); ++robot)
        prefer(static_cast<int>(robot), cells[robot], &preferences_[robot * num_actions]);
    std::ranges::fill(actions_, PibtStep<>::undecided);
    for (auto at = constraint; at.depth > 0; at = node.constraints[static_cast<std::size_t>(at.parent)]) {
        const int robot = node.order[at.depth - 1];
        const auto action = std::ranges::find(steps, at.cell - cells[robot]) - steps.begin();
        actions_[robot] = static_cast<std::uint8_t>(action);
    }
    if (!step_.complete(grid_.blocked.data(), cells, node.order, preferences_, actions_)) return false;
    for (std::size_t robot = 0; robot < starts_.size(); ++robot)
        new_state_[robot] = cells[robot] + steps[actions_[robot]];
    return true;
}

// All five actions, the closest to the goal first, equally good ones in random order.
void Lacam::prefer(int robot, int cell, std::uint8_t* preferences) {
    if (cell == goals_[robot]) {
        const int first = random_.below(idle);
        preferences[0] = idle;
        for (int rank = 0; rank < idle; ++rank) preferences[rank + 1] = static_cast<std::uint8_t>((first + rank) % idle);
        return;
    }
    const auto steps = grid_.layout.steps();
    std::array<int, num_actions> keys{};
    int draw = random_.below(1 << 3 * num_actions);
    for (int action = 0; action < num_actions; ++action, draw >>= 3) {
        const int next = cell + steps[action];
        const bool may_move = action != idle && !grid_.blocked[next];
        const int detour = may_move ? guidance_[robot].detour(cell, next) : 0;
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
    for (int at = goal_node_; at != none; at = nodes_[at].parent) nodes.push_back(at);
    std::ranges::reverse(nodes);
    const auto steps = grid_.layout.steps();
    JointPlan plan{std::vector<std::vector<std::uint8_t>>(starts_.size())};
    for (std::size_t robot = 0; robot < starts_.size(); ++robot) {
        auto& actions = plan.of_robot[robot];
        for (std::size_t time = 1; time < nodes.size(); ++time) {
            const int step = state(nodes[time])[robot] - state(nodes[time - 1])[robot];
            actions.push_back(static_cast<std::uint8_t>(std::ranges::find(steps, step) - steps.begin()));
        }
        while (!actions.empty() && actions.back() == idle) actions.pop_back();
    }
    return plan;
}

}  // namespace mapf
