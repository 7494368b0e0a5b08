// Bags: what the robots of many teams perceive, one robot after another. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>

#include <cstddef>
#include <cstdint>
#include <vector>

#include "mapf_env/native/arrays.hpp"
#include "mapf_env/native/senses.hpp"

namespace mapf {

// A team of a bag: its facts, its map, and memory that is its thread's alone.
template <class T>
struct BagTeam {
    TeamFacts facts;
    const T* obstacles;
    T* marks;                    // layout.size() zeros
    std::vector<int>& standing;  // -1 everywhere
};

// Makes a bag of `count` teams: (fov, scalars, edge_index, edge_weight, edge_attr, team).
//   size_of(t)             robots of team t
//   team_of(t, part, map)  team t in the hands of a thread, with what the map tells if it is asked for
//   number_of(t)           what `team` says of its robots
//   key_of(t)              the key by which messages are lost, with probability `loss`
//   for_each(count, job)   calls job(t, part) for all teams, over threads
template <class T, class SizeOf, class TeamOf, class NumberOf, class KeyOf, class ForEach>
nanobind::tuple make_bag(const Senses& senses, double loss, std::size_t count, SizeOf&& size_of, TeamOf&& team_of,
                         NumberOf&& number_of, KeyOf&& key_of, ForEach&& for_each) {
    std::vector<std::size_t> first_robot(count + 1, 0), first_edge(count + 1, 0);
    std::vector<std::vector<Edge>> edges(count);
    {
        nanobind::gil_scoped_release release;
        for_each(count, [&](std::size_t t, int part) {
            const BagTeam<T> team = team_of(t, part, false);
            find_edges(team.facts.layout, team.facts.positions, team.facts.num_agents, team.facts.comm_radius,
                       senses.weights, loss, key_of(t), team.standing, edges[t], team.facts.order);
        });
        for (std::size_t t = 0; t < count; ++t) {
            first_robot[t + 1] = first_robot[t] + size_of(t);
            first_edge[t + 1] = first_edge[t] + edges[t].size();
        }
    }
    const std::size_t M = first_robot[count], E = first_edge[count], C = senses.num_planes, side = senses.side();
    const std::size_t K = senses.robot_columns, D = senses.edge_columns;
    auto [fov, out_fov] = make_array<T>({M, C, side, side});
    auto [scalars, out_scalars] = make_array<float>({M, K});
    auto [index, out_index] = make_array<std::int64_t>({2, E});
    auto [weight, out_weight] = make_array<float>({E});
    auto [attributes, out_attributes] = make_array<float>({E, D});
    auto [number, out_number] = make_array<std::int64_t>({M});
    const auto write = [&, fov = fov, scalars = scalars, index = index, weight = weight, attributes = attributes,
                        number = number](std::size_t t, int part) {
        const BagTeam<T> team = team_of(t, part, senses.needs_map);
        const std::size_t robot = first_robot[t];
        write_views(senses, team.facts, team.obstacles, team.marks, fov + robot * senses.view());
        write_robot_features(senses, team.facts, scalars + robot * K);
        std::fill_n(number + robot, team.facts.num_agents, static_cast<std::int64_t>(number_of(t)));
        std::size_t e = first_edge[t];
        for (const Edge& edge : edges[t]) {
            index[e] = static_cast<std::int64_t>(robot + edge.sender);
            index[E + e] = static_cast<std::int64_t>(robot + edge.receiver);
            weight[e] = edge.weight;
            write_edge_features(senses, team.facts, edge.receiver, edge.sender, attributes + e * D);
            ++e;
        }
        std::vector<Edge>().swap(edges[t]);
    };
    {
        nanobind::gil_scoped_release release;
        for_each(count, write);
    }
    return nanobind::make_tuple(out_fov, out_scalars, out_index, out_weight, out_attributes, out_number);
}

}  // namespace mapf
