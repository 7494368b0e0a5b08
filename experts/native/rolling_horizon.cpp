#include "experts/native/rolling_horizon.hpp"

#include <algorithm>
#include <limits>
#include <numeric>
#include <utility>

#include "experts/native/traffic.hpp"

namespace mapf {

namespace {

constexpr int nobody = -1;
constexpr std::size_t smallest = 4, largest = 12;  // robots of a neighbourhood

}  // namespace

RollingHorizon::RollingHorizon(Grid grid, int window, int rounds, std::uint64_t seed)
    : grid_(std::move(grid)), window_(window), rounds_(rounds), steps_(grid_.layout.steps()), random_(seed),
      pibt_(grid_.layout), occupants_((static_cast<std::size_t>(window) + 1) * grid_.blocked.size(), nobody),
      layers_(static_cast<std::size_t>(window) + 1), reached_(grid_.blocked.size(), {nobody, nobody}) {}

bool RollingHorizon::reaches(int cell, int goal) {
    auto& table = tables_[goal];
    if (table.empty()) distances_to(grid_, goal, table, queue_);
    return table[cell] != unreachable;
}

void RollingHorizon::plan(std::span<const int> cells, std::span<const int> goals, int executed, Budget& budget) {
    const auto robots = cells.size();
    if (robots != cells_.size()) {
        actions_.clear();
        goals_.assign(robots, nobody);
        under_way_.assign(robots, 0);
    }
    table_of_.resize(robots);
    for (std::size_t robot = 0; robot < robots; ++robot) {
        reaches(cells[robot], goals[robot]);
        table_of_[robot] = tables_[goals[robot]].data();
        under_way_[robot] = goals[robot] == goals_[robot] ? under_way_[robot] + std::max(executed, 1) : 0;
    }
    // The rest of the last plan or a new one of PIBT, whichever promises more.
    const bool kept = keep_last_plan(cells, executed);
    cells_.assign(cells.begin(), cells.end());
    goals_.assign(goals.begin(), goals.end());
    costs_.resize(robots);
    actions_.resize(robots * static_cast<std::size_t>(window_));
    std::int64_t cost_kept = std::numeric_limits<std::int64_t>::max();
    if (kept) {
        roll_out(window_ - executed);
        cost_kept = assess();
        old_actions_ = actions_;
    }
    roll_out(0);
    if (assess() >= cost_kept) {
        actions_ = old_actions_;
        assess();
    }
    improve(budget);
}

// Moves the last plan `executed` steps on, if the robots stand where they should.
bool RollingHorizon::keep_last_plan(std::span<const int> cells, int executed) {
    if (actions_.empty() || executed >= window_) return false;
    for (std::size_t robot = 0; robot < cells.size(); ++robot) {
        auto* actions = actions_of(static_cast<int>(robot));
        int cell = cells_[robot];
        for (int time = 0; time < executed; ++time) cell += steps_[actions[time]];
        if (cell != cells[robot]) return false;
    }
    for (std::size_t robot = 0; robot < cells.size(); ++robot) {
        auto* actions = actions_of(static_cast<int>(robot));
        std::copy(actions + executed, actions + window_, actions);
    }
    return true;
}

// PIBT with swap decides all steps from time `from` on.
void RollingHorizon::roll_out(int from) {
    const auto robots = cells_.size();
    step_cells_ = cells_;
    preferences_.resize(robots * num_actions);
    step_actions_.resize(robots);
    order_.resize(robots);
    std::iota(order_.begin(), order_.end(), 0);
    std::vector<std::uint8_t> arrived(robots, 0);
    std::vector<std::uint8_t> five(num_actions);
    for (int time = 0; time < window_; ++time) {
        for (std::size_t robot = 0; robot < robots; ++robot) arrived[robot] |= step_cells_[robot] == goals_[robot];
        if (time >= from) {
            std::stable_sort(order_.begin(), order_.end(), [&](int a, int b) {
                return std::pair(arrived[a], -under_way_[a]) < std::pair(arrived[b], -under_way_[b]);
            });
            for (std::size_t robot = 0; robot < robots; ++robot) {
                std::iota(five.begin(), five.end(), std::uint8_t{0});
                random_.shuffle_front(five, num_actions);
                const auto* table = table_of_[robot];
                std::stable_sort(five.begin(), five.end(), [&](int a, int b) {
                    return table[step_cells_[robot] + steps_[a]] < table[step_cells_[robot] + steps_[b]];
                });
                std::copy(five.begin(), five.end(), &preferences_[robot * num_actions]);
            }
            const TableSwaps swaps{std::span<const int>(goals_), [&](int robot) { return table_of_[robot]; }};
            pibt_.decide(grid_.blocked.data(), step_cells_, order_, preferences_, step_actions_, swaps);
            for (std::size_t robot = 0; robot < robots; ++robot)
                actions_of(static_cast<int>(robot))[time] = step_actions_[robot];
        }
        for (std::size_t robot = 0; robot < robots; ++robot)
            step_cells_[robot] += steps_[actions_of(static_cast<int>(robot))[time]];
    }
}

// Finds the robots' costs, and their sum.
std::int64_t RollingHorizon::assess() {
    std::int64_t sum = 0;
    for (std::size_t robot = 0; robot < cells_.size(); ++robot) sum += costs_[robot] = cost_of(static_cast<int>(robot));
    return sum;
}

int RollingHorizon::cost_of(int robot) const {
    const auto* actions = actions_of(robot);
    int cell = cells_[robot];
    for (int time = 0; time < window_; ++time) {
        if (cell == goals_[robot]) return time;
        cell += steps_[actions[time]];
    }
    return window_ + table_of_[robot][cell];
}

// Large neighbourhood search: plans a few robots again and keeps what does not cost more.
void RollingHorizon::improve(Budget& budget) {
    const int robots = static_cast<int>(cells_.size());
    is_chosen_.assign(cells_.size(), 0);
    for (int robot = 0; robot < robots; ++robot) enter(robot);
    for (int round = 0; round < rounds_ && !budget.spent(); ++round) {
        int first = nobody;
        for (int draw = 0; draw < 3; ++draw) {
            const int robot = random_.below(robots);
            if (first == nobody || costs_[robot] - distance(robot) > costs_[first] - distance(first)) first = robot;
        }
        if (costs_[first] == distance(first)) continue;
        choose(first, smallest + static_cast<std::size_t>(random_.below(static_cast<int>(largest - smallest) + 1)));
        replan();
        for (const int robot : chosen_) is_chosen_[robot] = 0;
    }
    for (int robot = 0; robot < robots; ++robot) leave(robot);
}

// The robot, the robots in the way of its short paths, the robots in their way, and so on.
void RollingHorizon::choose(int first, std::size_t size) {
    chosen_.clear();
    const auto add = [&](int robot) {
        if (robot == nobody || is_chosen_[robot] || chosen_.size() >= size) return;
        is_chosen_[robot] = 1;
        chosen_.push_back(robot);
    };
    add(first);
    for (std::size_t i = 0; i < chosen_.size() && chosen_.size() < size; ++i) {
        const int robot = chosen_[i];
        const auto* table = table_of_[robot];
        int cell = cells_[robot];
        const int leaves = random_.below(window_);  // from here on it walks at random towards its goal
        for (int time = 0; time < window_ && chosen_.size() < size; ++time) {
            int action = actions_of(robot)[time];
            if (time >= leaves) {
                int ways = 0;
                for (int each = 0; each < idle; ++each)
                    if (table[cell + steps_[each]] < table[cell] && random_.below(++ways) == 0) action = each;
                if (ways == 0) break;
                add(occupant(time + 1, cell + steps_[action]));
                add(occupant(time, cell + steps_[action]));
            }
            cell += steps_[action];
        }
    }
}

// Plans the chosen robots one after the other in a random order, and keeps the result if it does not cost more.
void RollingHorizon::replan() {
    random_.shuffle_front(chosen_, static_cast<int>(chosen_.size()));
    old_actions_.clear();
    std::int64_t before = 0, least = 0;
    for (const int robot : chosen_) {
        leave(robot);
        old_actions_.insert(old_actions_.end(), actions_of(robot), actions_of(robot) + window_);
        before += costs_[robot];
        least += distance(robot);
    }
    std::size_t planned = 0;
    for (; planned < chosen_.size(); ++planned) {
        const int robot = chosen_[planned];
        least -= distance(robot);
        if (!search(robot, static_cast<int>(before - least))) break;
        enter(robot);
        least += cost_of(robot);
    }
    if (planned == chosen_.size()) {
        for (const int robot : chosen_) costs_[robot] = cost_of(robot);
        return;
    }
    for (std::size_t i = 0; i < planned; ++i) leave(chosen_[i]);
    for (std::size_t i = 0; i < chosen_.size(); ++i) {
        std::copy_n(&old_actions_[i * static_cast<std::size_t>(window_)], window_, actions_of(chosen_[i]));
        enter(chosen_[i]);
    }
}

// Finds the cheapest path of the robot among the others that costs at most `latest`, layer by layer of time.
bool RollingHorizon::search(int robot, int latest) {
    const auto* table = table_of_[robot];
    const int goal = goals_[robot];
    for (auto& layer : layers_) layer.clear();
    layers_[0].push_back({cells_[robot], nobody, cells_[robot] == goal ? 0 : forever, idle});
    for (int time = 0; time < window_; ++time) {
        auto& next = layers_[static_cast<std::size_t>(time) + 1];
        touched_.clear();
        for (int id = 0; id < static_cast<int>(layers_[time].size()); ++id) {
            const auto state = layers_[time][id];
            const bool arrived = state.arrival != forever;
            for (int turn = 0; turn < num_actions; ++turn) {
                const int action = (turn + idle) % num_actions;  // idle first
                const int cell = state.cell + steps_[action];
                if (table[cell] == unreachable || occupant(time + 1, cell) != nobody) continue;
                if (!arrived && time + 1 + table[cell] > latest) continue;
                const int other = occupant(time, cell);
                if (other != nobody && action != idle && occupant(time + 1, state.cell) == other) continue;
                const int arrival = arrived ? state.arrival : cell == goal ? time + 1 : forever;
                if (arrival != forever && arrival > latest) continue;
                auto& known = reached_[cell][arrival != forever];
                if (known != nobody) {
                    if (next[known].arrival > arrival) next[known] = {cell, id, arrival, static_cast<std::uint8_t>(action)};
                    continue;
                }
                known = static_cast<int>(next.size());
                touched_.push_back(cell);
                next.push_back({cell, id, arrival, static_cast<std::uint8_t>(action)});
            }
        }
        for (const int cell : touched_) reached_[cell] = {nobody, nobody};
    }
    const auto cost = [&](const State& state) {
        return std::pair(state.arrival != forever ? state.arrival : window_ + table[state.cell], int{table[state.cell]});
    };
    const auto& last = layers_.back();
    const auto best = std::min_element(last.begin(), last.end(),
                                       [&](const State& a, const State& b) { return cost(a) < cost(b); });
    if (best == last.end()) return false;
    int id = static_cast<int>(best - last.begin());
    for (int time = window_; time > 0; --time) {
        const auto& state = layers_[time][id];
        actions_of(robot)[time - 1] = state.action;
        id = state.parent;
    }
    return true;
}

void RollingHorizon::enter(int robot) {
    int cell = cells_[robot];
    occupant(0, cell) = robot;
    for (int time = 0; time < window_; ++time) occupant(time + 1, cell += steps_[actions_of(robot)[time]]) = robot;
}

void RollingHorizon::leave(int robot) {
    int cell = cells_[robot];
    occupant(0, cell) = nobody;
    for (int time = 0; time < window_; ++time) occupant(time + 1, cell += steps_[actions_of(robot)[time]]) = nobody;
}

}  // namespace mapf
