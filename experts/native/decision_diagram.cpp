#include "experts/native/decision_diagram.hpp"

#include <algorithm>
#include <limits>

namespace mapf {

namespace {

constexpr int lengths_to_try = 3;  // lengths to try before looking for the first that is possible
constexpr int longest_recursion = 5'000;  // one level per step; longer paths are not compared
constexpr std::size_t most_joint_states = 20'000;

}  // namespace

void DiagramBuilder::build(const Grid& grid, int start, int goal, const Distance* distance, const Constraints& constraints,
                           DecisionDiagram& diagram, Budget& budget) {
    distance_ = distance;
    steps_ = grid.layout.steps();
    // Read the constraints: no path is shorter than `shortest`, and after `last_constraint` nothing changes any more.
    closed_from_.resize(grid.blocked.size(), forever);
    index_of_.resize(grid.blocked.size());
    banned_.clear();
    int shortest = std::max<int>(distance[start], constraints.earliest), last_constraint = 0;
    for (const auto& ban : constraints.bans) {
        banned_(ban.cell, ban.time) |= ban.actions;
        last_constraint = std::max(last_constraint, ban.time);
        if (ban.cell == goal && ban.actions == all_actions) shortest = std::max(shortest, ban.time + 1);
    }
    for (const auto& closed : constraints.closed_cells) {
        closed_from_[closed.cell] = std::min(closed_from_[closed.cell], closed.time);
        last_constraint = std::max(last_constraint, closed.time);
    }
    // Try the shortest lengths one by one; then flood forward for the first arrival that is possible.
    diagram.length = -1;
    const int last_try = std::min(constraints.latest, shortest + lengths_to_try);
    int length = shortest;
    while (length <= last_try && !try_length(start, length, diagram, budget)) ++length;
    if (length > last_try && last_try < constraints.latest) {
        length = first_arrival(start, goal, length, constraints.latest, last_constraint, budget);
        if (length != forever) try_length(start, length, diagram, budget);
    }
    for (const auto& closed : constraints.closed_cells) closed_from_[closed.cell] = forever;
}

// Returns the first time in earliest..latest at which the robot can arrive, or `forever`.
int DiagramBuilder::first_arrival(int start, int goal, int earliest, int latest, int last_constraint, Budget& budget) {
    frontier_.assign(1, start);
    reached_at_.assign(closed_from_.size(), -1);
    for (int time = 1; time <= latest && !frontier_.empty(); ++time) {
        bool arrives = false;
        next_frontier_.clear();
        for (const int cell : frontier_) {
            if (budget.spent()) return forever;
            for (int action = 0; action < num_actions; ++action) {
                const int next = cell + steps_[action];
                if (distance_[next] == unreachable || time >= closed_from_[next]) continue;
                if (banned_.at(next, time) >> action & 1) continue;
                arrives |= next == goal && action != idle;
                if (reached_at_[next] == time) continue;
                reached_at_[next] = time;
                next_frontier_.push_back(next);
            }
        }
        if (arrives && time >= earliest) return time;
        // After the last constraint the set of reached cells only grows: if it does not, no later arrival is possible.
        // Two more steps let the robot leave its goal and come back.
        if (time > std::max(last_constraint, earliest) + 2 && next_frontier_.size() == frontier_.size()) break;
        std::swap(frontier_, next_frontier_);
    }
    return forever;
}

bool DiagramBuilder::try_length(int start, int length, DecisionDiagram& diagram, Budget& budget) {
    // Forward: level by level, the cells from which the goal can still be reached in time.
    diagram.nodes.clear();
    diagram.level.assign(1, 0);
    const DecisionDiagram::Node nowhere{start, {-1, -1, -1, -1, -1}};
    diagram.nodes.push_back(nowhere);
    diagram.level.push_back(1);
    for (int time = 1; time <= length; ++time) {
        const int begin = diagram.level[time - 1], end = diagram.level[time];
        for (int id = begin; id < end; ++id) {
            if (budget.spent()) return false;
            const int cell = diagram.nodes[id].cell;
            for (int action = 0; action < num_actions; ++action) {
                const int next = cell + steps_[action];
                if (distance_[next] == unreachable || time + distance_[next] > length) continue;
                if (time >= closed_from_[next]) continue;
                if (time == length && action == idle) continue;  // the path would be shorter
                if (banned_.at(next, time) >> action & 1) continue;
                int& index = index_of_[next];
                if (index < end || index >= static_cast<int>(diagram.nodes.size()) ||
                    diagram.nodes[index].cell != next) {
                    index = static_cast<int>(diagram.nodes.size());
                    diagram.nodes.push_back({next, nowhere.next});
                }
                diagram.nodes[id].next[action] = index;
            }
        }
        diagram.level.push_back(static_cast<int>(diagram.nodes.size()));
        if (diagram.level[time + 1] == diagram.level[time]) return false;
    }
    // Backward: remove the nodes without a successor.
    diagram.length = length;
    prune(diagram);
    return true;
}

// Removes the nodes from which the last level cannot be reached, and renumbers the others.
void DiagramBuilder::prune(DecisionDiagram& diagram) {
    auto& nodes = diagram.nodes;
    new_index_.assign(nodes.size(), 0);
    for (int id = static_cast<int>(nodes.size()) - 1; id >= 0; --id) {
        bool alive = id >= diagram.level[diagram.length];
        for (int& next : nodes[id].next) {
            if (next >= 0 && new_index_[next] < 0) next = -1;
            alive |= next >= 0;
        }
        new_index_[id] = alive ? 0 : -1;
    }
    int kept = 0;
    for (int& index : new_index_)
        if (index == 0) index = kept++;
    for (std::size_t id = 0; id < nodes.size(); ++id) {
        if (new_index_[id] < 0) continue;
        auto node = nodes[id];
        for (int& next : node.next)
            if (next >= 0) next = new_index_[next];
        nodes[static_cast<std::size_t>(new_index_[id])] = node;
    }
    for (std::size_t time = 1; time < diagram.level.size(); ++time) {
        int id = diagram.level[time];
        while (id < static_cast<int>(new_index_.size()) && new_index_[id] < 0) ++id;
        diagram.level[time] = id < static_cast<int>(new_index_.size()) ? new_index_[id] : kept;
    }
    nodes.resize(static_cast<std::size_t>(kept));
}

int DiagramBuilder::best_path(const DecisionDiagram& diagram, const Traffic& traffic,
                              std::vector<std::uint8_t>& actions) {
    constexpr int unvisited = std::numeric_limits<int>::max();
    reached_.assign(diagram.nodes.size(), {unvisited, -1, 0});
    reached_[0].conflicts = 0;
    for (int time = 0; time < diagram.length; ++time)
        for (int id = diagram.level[time]; id < diagram.level[time + 1]; ++id) {
            const auto& node = diagram.nodes[id];
            const auto& here = traffic.at(node.cell, time + 1);
            for (int action = 0; action < num_actions; ++action) {
                const int next = node.next[action];
                if (next < 0) continue;
                const int cell = diagram.nodes[next].cell;
                const int conflicts = reached_[id].conflicts +
                                      (action == idle ? 0 : here.by_move[reversed(action)]) +
                                      traffic.vertex_conflicts(traffic.at(cell, time + 1), cell, time + 1);
                if (conflicts < reached_[next].conflicts)
                    reached_[next] = {conflicts, id, static_cast<std::uint8_t>(action)};
            }
        }
    int id = static_cast<int>(diagram.nodes.size()) - 1;  // the goal
    const int found = reached_[id].conflicts + traffic.visits_after(diagram.nodes[id].cell, diagram.length);
    actions.resize(static_cast<std::size_t>(diagram.length));
    for (int time = diagram.length; time > 0; --time) {
        actions[time - 1] = reached_[id].action;
        id = reached_[id].parent;
    }
    return found;
}

bool JointSearch::compatible(const DecisionDiagram& first, const DecisionDiagram& second) {
    first_ = &first;
    second_ = &second;
    if (first.length > second.length) std::swap(first_, second_);
    if (second_->length > longest_recursion) return true;
    failed_.clear();
    return search(0, 0, 0);
}

// Returns true if the robots can complete compatible paths from nodes i and j at `time`.
bool JointSearch::search(int time, int i, int j) {
    if (time == second_->length) return true;
    if (failed_.size() > most_joint_states) return true;
    const auto& b = second_->nodes[j];
    const bool rests = time >= first_->length;
    const auto& a = first_->nodes[i];
    for (int action = 0; action < num_actions; ++action) {
        const int next_j = b.next[action];
        if (next_j < 0) continue;
        const int cell_j = second_->nodes[next_j].cell;
        if (rests) {
            if (cell_j == a.cell || failed_.at(i, next_j)) continue;
            if (search(time + 1, i, next_j)) return true;
            continue;
        }
        for (const int next_i : a.next) {
            if (next_i < 0) continue;
            const int cell_i = first_->nodes[next_i].cell;
            if (cell_i == cell_j || (cell_i == b.cell && cell_j == a.cell) || failed_.at(next_i, next_j)) continue;
            if (search(time + 1, next_i, next_j)) return true;
        }
    }
    failed_(i, j) = 1;
    return false;
}

}  // namespace mapf
