// The communication graph: which robot hears which.
#pragma once

#include <cstdint>
#include <vector>

#include "mapf_env/native/grid.hpp"

namespace mapf {

enum class Weights : int {
    binary,    // 1
    distance,  // 1 / distance
};

// Writes the weights (num_agents, num_agents), `stride` floats apart: of two different robots closer than `radius`, else
// 0. `rows` and `cols` are scratch.
void communication_graph(const std::int32_t* positions, int num_agents, double radius, Weights weights, int stride,
                         std::vector<float>& rows, std::vector<float>& cols, float* out);

// Robot `receiver` hears robot `sender`.
struct Edge {
    int receiver, sender;
    float weight;
};

// Appends the edges that `communication_graph` writes, by receiver, then sender, except those that `loss` takes by `key`.
// In a team that is larger than the neighbourhood of a robot, its neighbourhood is searched instead of the team.
//   standing  layout.size() of -1; the same again on return
//   order     the robots in the order in which they are searched around, as of `order_by_tile`
void find_edges(const Layout& layout, const std::int32_t* positions, int num_agents, double radius, Weights weights,
                double loss, std::uint64_t key, std::vector<int>& standing, std::vector<Edge>& edges,
                const int* order = nullptr);

// Sets each weight (num_agents, num_agents), `stride` apart, to 0 with probability `loss`, drawn by `key`.
void lose_messages(int num_agents, double loss, std::uint64_t key, int stride, float* weights);

// The least radius * 1.1^k, k = 0, 1, ..., at which all robots are connected; radius > 0.
double connecting_radius(const std::int32_t* positions, int num_agents, double radius);

}  // namespace mapf
