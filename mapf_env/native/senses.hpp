// Perception beyond the paper's three channels. Every channel of the views, feature of a robot and feature of an
// edge is declared once, by a row of a table in senses.cpp.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "mapf_env/native/graph.hpp"
#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/ways.hpp"

namespace mapf {

// Number of last moves that a robot remembers.
inline constexpr int history = 16;

// One team at one moment, as the kernels read it.
struct TeamFacts {
    Layout layout{};
    int num_agents = 0;
    const std::int32_t* positions = nullptr;  // (N, 2)
    const std::int32_t* goals = nullptr;      // (N, 2)
    const std::int8_t* moves = nullptr;       // (N, history) executed moves, newest first; -1 before the start
    const std::int32_t* under_way = nullptr;  // (N) steps since the robot was on its goal
    WayTables ways;                           // steps to the goals at least as far as robots see, where a sense needs the map
    const std::uint8_t* greedy = nullptr;     // (N) of `find_greedy_moves`, where a sense needs the map
    const int* order = nullptr;               // as of `order_by_tile`
    std::uint64_t seed = 0;
    std::int64_t time = 0, limit = 1;
    double comm_radius = 0.0;

    int cell(int robot) const { return layout.cell(positions[2 * robot], positions[2 * robot + 1]); }
    int goal(int robot) const { return layout.cell(goals[2 * robot], goals[2 * robot + 1]); }
    // Steps to the goal from where the robot stands, as an entry of its table.
    const Distance* way(int robot) const {
        return ways.at(layout, robot, positions[2 * robot], positions[2 * robot + 1]);
    }
    bool on_goal(int robot) const { return cell(robot) == goal(robot); }
};

// A channel of the views. Values lie in low..high; as a byte, value v is (v - low) * unit.
struct Channel {
    // Writes the plane of each robot, `num_planes` planes apart; `marks` is layout.size() zeros, which it restores.
    template <class T>
    using Write = void (*)(const TeamFacts& team, int radius, int num_planes, T* marks, T* out);

    const char* name;
    double low, high;
    double (*unit)(int radius);
    bool needs_map, needs_history;
    Write<float> write_floats;
    Write<std::uint8_t> write_bytes;
};

// A feature of each robot: `width` columns with values in low..high.
struct RobotFeature {
    const char* name;
    int (*width)(int memory);
    double low, high;
    bool needs_map, needs_history;
    void (*write)(const TeamFacts& team, int memory, int robot, float* out);
};

// A feature of each edge: what the receiver knows about the sender.
struct EdgeFeature {
    const char* name;
    int (*width)(int memory);
    double low, high;
    bool needs_map, needs_history;
    void (*write)(const TeamFacts& team, int memory, int receiver, int sender, float* out);
};

std::span<const Channel> channels();  // the paper's three first, which have no writers here: `observe` writes them
std::span<const RobotFeature> robot_features();
std::span<const EdgeFeature> edge_features();

// The senses of the robots of a team: what is observed, in which order.
struct Senses {
    int fov_radius = 1, memory = 1;
    Weights weights = Weights::binary;
    std::vector<const Channel*> extra_channels;
    std::vector<const RobotFeature*> robot_features;
    std::vector<const EdgeFeature*> edge_features;
    int num_planes = 0, robot_columns = 0, edge_columns = 0;
    bool needs_map = false;

    Senses() = default;
    // Throws std::invalid_argument if a name is unknown or a number out of range.
    Senses(int fov_radius, int memory, Weights weights, const std::vector<std::string>& extra_channels,
           const std::vector<std::string>& robot_features, const std::vector<std::string>& edge_features);

    int side() const { return 2 * fov_radius + 3; }
    int view() const { return num_planes * side() * side(); }
};

// Writes the moves (N) that bring each robot one step nearer to its goal, as bits; idle on the goal or without a way.
void find_greedy_moves(const TeamFacts& team, std::vector<std::uint8_t>& greedy);

// Writes the views (N, num_planes, side, side) of a team on a map of `obstacles`; `marks` is layout.size() zeros.
template <class T>
void write_views(const Senses& senses, const TeamFacts& team, const T* obstacles, T* marks, T* out);

// Writes the features (N, robot_columns) of the robots of a team.
void write_robot_features(const Senses& senses, const TeamFacts& team, float* out);

// Writes the features (edge_columns) of one edge.
void write_edge_features(const Senses& senses, const TeamFacts& team, int receiver, int sender, float* out);

}  // namespace mapf
