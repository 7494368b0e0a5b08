#include "mapf_env/native/senses.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <stdexcept>
#include <type_traits>

#include "mapf_env/native/observe.hpp"
#include "mapf_env/native/pibt_shield.hpp"

namespace mapf {

namespace {

// Writes the windows of `marks` around all robots of a team. `hide(robot, true)` takes from the marks what this robot is
// not shown, `hide(robot, false)` brings it back.
template <class T, class Hide>
void copy_windows(const TeamFacts& team, int radius, int num_planes, const T* marks, T* out, Hide&& hide) {
    const int side = 2 * radius + 3;
    for (int k = 0; k < team.num_agents; ++k) {
        const int i = team.order ? team.order[k] : k, row = team.positions[2 * i], col = team.positions[2 * i + 1];
        hide(i, true);
        copy_window<0>(marks + team.layout.cell(row - radius, col - radius), team.layout.stride(), radius,
                       out + static_cast<std::size_t>(i) * num_planes * side * side);
        hide(i, false);
    }
}

constexpr auto hide_nothing = [](int, bool) {};

// ---- channels: each writes the plane of every robot of a team

// The distance to the goal from each cell in view minus that from the robot's cell, clipped to -2 * radius..2 * radius;
// unreachable cells have 2 * radius. Floats are divided by 2 * radius; bytes are offset by 2 * radius.
template <class T>
void write_cost_to_go(const TeamFacts& team, int radius, int num_planes, T*, T* out) {
    const int side = 2 * radius + 3, plane = side * side, reach = 2 * radius, stride = team.ways.shape.cols;
    for (int i = 0; i < team.num_agents; ++i, out += num_planes * plane) {
        const Distance* const way = team.way(i);
        const int here = *way;
        std::fill_n(out, plane, static_cast<T>(std::is_same_v<T, float> ? 0 : reach));  // the ring is 0
        for (int down = -radius; down <= radius; ++down)
            for (int right = -radius; right <= radius; ++right) {
                const int there = way[down * stride + right];
                const int more = there == unreachable ? reach : std::clamp(there - here, -reach, reach);
                T& value = out[(down + radius + 1) * side + right + radius + 1];
                if constexpr (std::is_same_v<T, float>)
                    value = static_cast<float>(more) / static_cast<float>(reach);
                else
                    value = static_cast<T>(more + reach);
            }
    }
}

// The goals of other robots.
template <class T>
void write_other_goals(const TeamFacts& team, int radius, int num_planes, T* marks, T* out) {
    mark(team.layout, team.goals, team.num_agents, T{1}, marks);
    copy_windows(team, radius, num_planes, marks, out, [&](int i, bool hidden) { marks[team.goal(i)] = T(!hidden); });
    mark(team.layout, team.goals, team.num_agents, T{0}, marks);
}

// The positions of robots one step before.
template <class T>
void write_previous_positions(const TeamFacts& team, int radius, int num_planes, T* marks, T* out) {
    const auto steps = team.layout.steps();
    const auto mark_all = [&](T value) {
        for (int i = 0; i < team.num_agents; ++i) {
            const int move = team.moves[i * history];
            marks[team.cell(i) - (move < 0 ? 0 : steps[move])] = value;
        }
    };
    mark_all(T{1});
    copy_windows(team, radius, num_planes, marks, out, hide_nothing);
    mark_all(T{0});
}

// Each other robot spreads a mass of 1 equally over the cells to which its greedy moves lead. It is counted in twelfths,
// which one to four cells share without a remainder.
template <class T>
void write_greedy_cells(const TeamFacts& team, int radius, int num_planes, T* marks, T* out) {
    constexpr int mass = 12;
    const auto steps = team.layout.steps();
    const auto spread = [&](int i, int sign) {
        const int share = sign * mass / std::popcount(team.greedy[i]);
        for (int action = 0; action < num_actions; ++action)
            if (team.greedy[i] >> action & 1) {
                T& place = marks[team.cell(i) + steps[action]];
                place = static_cast<T>(place + share);
            }
    };
    for (int i = 0; i < team.num_agents; ++i) spread(i, 1);
    copy_windows(team, radius, num_planes, marks, out, [&](int i, bool hidden) { spread(i, hidden ? -1 : 1); });
    for (int i = 0; i < team.num_agents; ++i) spread(i, -1);
    if constexpr (std::is_same_v<T, float>) {
        const int plane = (2 * radius + 3) * (2 * radius + 3);
        for (int i = 0; i < team.num_agents; ++i, out += num_planes * plane)
            for (int k = 0; k < plane; ++k) out[k] /= mass;
    }
}

// The robots on their goals, this robot included.
template <class T>
void write_robots_on_goals(const TeamFacts& team, int radius, int num_planes, T* marks, T* out) {
    const auto mark_all = [&](T value) {
        for (int i = 0; i < team.num_agents; ++i)
            if (team.on_goal(i)) marks[team.cell(i)] = value;
    };
    mark_all(T{1});
    copy_windows(team, radius, num_planes, marks, out, hide_nothing);
    mark_all(T{0});
}

// ---- features of robots; an edge has the same ones of its sender

// The last `memory` moves, newest first, each as five columns of which one is 1; zeros before the start.
void write_last_moves(const TeamFacts& team, int memory, int robot, float* out) {
    std::fill_n(out, num_actions * memory, 0.0f);
    for (int k = 0; k < memory; ++k)
        if (const int move = team.moves[robot * history + k]; move >= 0) out[num_actions * k + move] = 1.0f;
}

void write_on_goal(const TeamFacts& team, int, int robot, float* out) { *out = team.on_goal(robot) ? 1.0f : 0.0f; }

void write_steps_left(const TeamFacts& team, int, int, float* out) {
    const auto left = std::clamp<std::int64_t>(team.limit - team.time, 0, team.limit);
    *out = static_cast<float>(static_cast<double>(left) / static_cast<double>(team.limit));
}

float scaled_steps(double steps) { return static_cast<float>(std::min(1.0, std::log2(1.0 + steps) / 16.0)); }

void write_steps_to_go(const TeamFacts& team, int, int robot, float* out) {
    const Distance steps = *team.way(robot);
    *out = steps == unreachable ? 1.0f : scaled_steps(steps);
}

void write_under_way(const TeamFacts& team, int, int robot, float* out) { *out = scaled_steps(team.under_way[robot]); }

void write_greedy_moves(const TeamFacts& team, int, int robot, float* out) {
    for (int action = 0; action < num_actions; ++action) out[action] = team.greedy[robot] >> action & 1 ? 1.0f : 0.0f;
}

// Off the goal, on a cell where the robot stood at one of its last steps: it was stopped, or came back.
void write_stuck(const TeamFacts& team, int, int robot, float* out) {
    *out = 0.0f;
    if (team.on_goal(robot)) return;
    int down = 0, right = 0;
    for (int k = 0; k < history; ++k) {
        const int move = team.moves[robot * history + k];
        if (move < 0) return;
        down += row_step[move];
        right += col_step[move];
        if (down == 0 && right == 0) {
            *out = 1.0f;
            return;
        }
    }
}

// Off the goal, and on at most three cells in all of its last steps.
void write_jammed(const TeamFacts& team, int, int robot, float* out) {
    *out = 0.0f;
    if (team.on_goal(robot)) return;
    std::array<std::array<int, 2>, 3> stood{};  // relative to where it is now
    int cells = 1, down = 0, right = 0;
    for (int k = 0; k < history; ++k) {
        const int move = team.moves[robot * history + k];
        if (move < 0) return;
        down -= row_step[move];
        right -= col_step[move];
        const std::array<int, 2> cell{down, right};
        if (std::find(stood.begin(), stood.begin() + cells, cell) != stood.begin() + cells) continue;
        if (cells == static_cast<int>(stood.size())) return;
        stood[cells++] = cell;
    }
    *out = 1.0f;
}

// ---- features of edges alone

void write_relative_position(const TeamFacts& team, int, int receiver, int sender, float* out) {
    for (int axis = 0; axis < 2; ++axis)
        out[axis] = static_cast<float>((team.positions[2 * sender + axis] - team.positions[2 * receiver + axis]) /
                                       team.comm_radius);
}

void write_goal_direction(const TeamFacts& team, int, int, int sender, float* out) {
    const double down = team.goals[2 * sender] - team.positions[2 * sender];
    const double right = team.goals[2 * sender + 1] - team.positions[2 * sender + 1];
    const double length = down == 0.0 && right == 0.0 ? 1.0 : std::hypot(down, right);
    out[0] = static_cast<float>(down / length);
    out[1] = static_cast<float>(right / length);
}

void write_priority(const TeamFacts& team, int, int receiver, int sender, float* out) {
    const std::uint64_t key = seed_for(Use::priorities, team.seed);
    *out = pibt_rank(team.under_way[sender], key, sender) < pibt_rank(team.under_way[receiver], key, receiver) ? 1.0f
                                                                                                              : 0.0f;
}

template <auto write>
void of_sender(const TeamFacts& team, int memory, int, int sender, float* out) {
    write(team, memory, sender, out);
}

// ---- the tables: whatever else knows a channel or a feature reads it here

constexpr double steps_of_view(int radius) { return 2.0 * radius; }
template <int count>
constexpr double unit(int) { return count; }
template <int count>
constexpr int width(int) { return count; }
constexpr int moves_width(int memory) { return num_actions * memory; }

#define MAPF_BOTH(kernel) kernel<float>, kernel<std::uint8_t>

// name, low, high, unit, needs the map, needs history, kernel
constexpr std::array all_channels{
    Channel{"obstacles", 0, 1, unit<1>, false, false, nullptr, nullptr},
    Channel{"goal", 0, 1, unit<1>, false, false, nullptr, nullptr},
    Channel{"robots", 0, 1, unit<1>, false, false, nullptr, nullptr},
    Channel{"cost_to_go", -1, 1, steps_of_view, true, false, MAPF_BOTH(write_cost_to_go)},
    Channel{"other_goals", 0, 1, unit<1>, false, false, MAPF_BOTH(write_other_goals)},
    Channel{"previous_positions", 0, 1, unit<1>, false, true, MAPF_BOTH(write_previous_positions)},
    Channel{"greedy_cells", 0, 5, unit<12>, true, false, MAPF_BOTH(write_greedy_cells)},
    Channel{"robots_on_goals", 0, 1, unit<1>, false, false, MAPF_BOTH(write_robots_on_goals)},
};
#undef MAPF_BOTH

// name, width, low, high, needs the map, needs history, kernel
constexpr std::array all_robot_features{
    RobotFeature{"last_moves", moves_width, 0, 1, false, true, write_last_moves},
    RobotFeature{"on_goal", width<1>, 0, 1, false, false, write_on_goal},
    RobotFeature{"steps_left", width<1>, 0, 1, false, false, write_steps_left},
    RobotFeature{"steps_to_go", width<1>, 0, 1, true, false, write_steps_to_go},
    RobotFeature{"under_way", width<1>, 0, 1, false, true, write_under_way},
    RobotFeature{"greedy_moves", width<5>, 0, 1, true, false, write_greedy_moves},
    RobotFeature{"stuck", width<1>, 0, 1, false, true, write_stuck},
    RobotFeature{"jammed", width<1>, 0, 1, false, true, write_jammed},
};

constexpr std::array all_edge_features{
    EdgeFeature{"relative_position", width<2>, -1, 1, false, false, write_relative_position},
    EdgeFeature{"goal_direction", width<2>, -1, 1, false, false, write_goal_direction},
    EdgeFeature{"greedy_moves", width<5>, 0, 1, true, false, of_sender<write_greedy_moves>},
    EdgeFeature{"last_moves", moves_width, 0, 1, false, true, of_sender<write_last_moves>},
    EdgeFeature{"on_goal", width<1>, 0, 1, false, false, of_sender<write_on_goal>},
    EdgeFeature{"priority", width<1>, 0, 1, false, true, write_priority},
};

template <class Row>
std::vector<const Row*> rows_of(std::span<const Row> table, const std::vector<std::string>& names) {
    std::vector<const Row*> rows;
    for (const auto& name : names) {
        const auto row = std::find_if(table.begin(), table.end(), [&](const Row& each) { return each.name == name; });
        if (row == table.end()) throw std::invalid_argument("there is no sense with the name " + name);
        rows.push_back(&*row);
    }
    return rows;
}

template <class Row>
bool any_needs_map(const std::vector<const Row*>& rows) {
    return std::any_of(rows.begin(), rows.end(), [](const Row* row) { return row->needs_map; });
}

template <class Row>
int columns(const std::vector<const Row*>& rows, int memory) {
    int count = 0;
    for (const Row* row : rows) count += row->width(memory);
    return count;
}

}  // namespace

std::span<const Channel> channels() { return all_channels; }
std::span<const RobotFeature> robot_features() { return all_robot_features; }
std::span<const EdgeFeature> edge_features() { return all_edge_features; }

Senses::Senses(int fov_radius, int memory, Weights weights, const std::vector<std::string>& extra_channels,
               const std::vector<std::string>& robot_features, const std::vector<std::string>& edge_features)
    : fov_radius(fov_radius), memory(memory), weights(weights),
      extra_channels(rows_of(channels().subspan(num_channels), extra_channels)),
      robot_features(rows_of(mapf::robot_features(), robot_features)),
      edge_features(rows_of(mapf::edge_features(), edge_features)) {
    if (fov_radius < 1) throw std::invalid_argument("fov_radius must be at least 1");
    if (memory < 1 || memory > history) throw std::invalid_argument("memory must lie in 1..16");
    num_planes = num_channels + static_cast<int>(this->extra_channels.size());
    robot_columns = columns(this->robot_features, memory);
    edge_columns = columns(this->edge_features, memory);
    needs_map = any_needs_map(this->extra_channels) || any_needs_map(this->robot_features) ||
                any_needs_map(this->edge_features);
}

void find_greedy_moves(const TeamFacts& team, std::vector<std::uint8_t>& greedy) {
    greedy.resize(team.num_agents);
    const int cols = team.ways.shape.cols;
    for (int i = 0; i < team.num_agents; ++i) {
        const Distance* const way = team.way(i);
        unsigned moves = 0;
        if (*way != unreachable)
            for (int action = 0; action < idle; ++action)
                moves |= static_cast<unsigned>(way[row_step[action] * cols + col_step[action]] < *way) << action;
        greedy[i] = static_cast<std::uint8_t>(moves ? moves : 1u << idle);
    }
}

template <class T>
void write_views(const Senses& senses, const TeamFacts& team, const T* obstacles, T* marks, T* out) {
    observe(team.layout, obstacles, team.positions, team.goals, team.num_agents, senses.fov_radius, senses.num_planes,
            marks, out, team.order);
    T* plane = out + num_channels * senses.side() * senses.side();
    for (const Channel* channel : senses.extra_channels) {
        if constexpr (std::is_same_v<T, float>)
            channel->write_floats(team, senses.fov_radius, senses.num_planes, marks, plane);
        else
            channel->write_bytes(team, senses.fov_radius, senses.num_planes, marks, plane);
        plane += senses.side() * senses.side();
    }
}

template void write_views(const Senses&, const TeamFacts&, const float*, float*, float*);
template void write_views(const Senses&, const TeamFacts&, const std::uint8_t*, std::uint8_t*, std::uint8_t*);

void write_robot_features(const Senses& senses, const TeamFacts& team, float* out) {
    for (int i = 0; i < team.num_agents; ++i)
        for (const RobotFeature* feature : senses.robot_features) {
            feature->write(team, senses.memory, i, out);
            out += feature->width(senses.memory);
        }
}

void write_edge_features(const Senses& senses, const TeamFacts& team, int receiver, int sender, float* out) {
    for (const EdgeFeature* feature : senses.edge_features) {
        feature->write(team, senses.memory, receiver, sender, out);
        out += feature->width(senses.memory);
    }
}

}  // namespace mapf
