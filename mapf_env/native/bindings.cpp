// The Python interface of the kernels: shapes are checked here, the kernels trust them.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <tuple>

#include "mapf_env/native/arrays.hpp"
#include "mapf_env/native/checks.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/generate.hpp"
#include "mapf_env/native/goals.hpp"
#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/graph.hpp"
#include "mapf_env/native/observe.hpp"
#include "mapf_env/native/perceive.hpp"
#include "mapf_env/native/pibt_shield.hpp"
#include "mapf_env/native/shield.hpp"
#include "mapf_env/native/stepper.hpp"
#include "mapf_env/native/team_step.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using mapf::fail;
using mapf::In;
using mapf::InOut;
using mapf::Layout;
using mapf::make_array;
using mapf::Out;
using mapf::require;
using mapf::shown;

mapf::Grid to_grid(const In<bool, 2>& grid) {
    return {reinterpret_cast<const std::uint8_t*>(grid.data()), static_cast<int>(grid.shape(0)),
            static_cast<int>(grid.shape(1))};
}

void write_obstacles(const mapf::Grid& grid, bool* out) {
    for (int row = 0; row < grid.layout.height; ++row)
        for (int col = 0; col < grid.layout.width; ++col) *out++ = grid.blocked[grid.layout.cell(row, col)] != 0;
}

// The layout of maps (B, rows, cols) that carry a border of `border` obstacles.
template <class Array>
Layout layout_of(const Array& obstacles, int border) {
    const int rows = static_cast<int>(obstacles.shape(1)), cols = static_cast<int>(obstacles.shape(2));
    require(border >= 1 && rows > 2 * border && cols > 2 * border, "obstacles must have a border of at least one cell");
    const Layout layout{rows - 2 * border, cols - 2 * border, border};
    // Flood fills and moves rely on this: no step leads off the map.
    bool closed = true;
    for (std::size_t b = 0; b < obstacles.shape(0); ++b) {
        const auto* map = obstacles.data() + b * layout.size();
        for (int row = -1; row <= layout.height; ++row)
            closed &= map[layout.cell(row, -1)] != 0 && map[layout.cell(row, layout.width)] != 0;
        for (int col = 0; col < layout.width; ++col)
            closed &= map[layout.cell(-1, col)] != 0 && map[layout.cell(layout.height, col)] != 0;
    }
    require(closed, "obstacles must have a border of obstacles, as bordered() makes it");
    return layout;
}

// Positions come from Python: a cell outside the map would be read outside the array.
template <class Cells>
void require_on_map(const Cells& cells, const Layout& layout, std::size_t num_envs, const char* name) {
    if (cells.shape(0) != num_envs || cells.shape(2) != 2) fail(std::string(name) + " must have shape (B, N, 2)");
    const std::int32_t* cell = cells.data();
    for (std::size_t i = 0; i < cells.shape(0) * cells.shape(1); ++i, cell += 2)
        if (!layout.contains(cell[0], cell[1]))
            fail(std::string(name) + " of agent " + std::to_string(i % cells.shape(1)) + " in environment " +
                 std::to_string(i / cells.shape(1)) + ", (" + std::to_string(cell[0]) + ", " +
                 std::to_string(cell[1]) + "), lies outside the map");
}

Out<std::int32_t> regions(In<bool, 2> grid) {
    const auto map = to_grid(grid);
    const auto found = mapf::regions_of(map);
    auto [region, out] = make_array<std::int32_t>({grid.shape(0), grid.shape(1)});
    for (int row = 0; row < map.layout.height; ++row, region += map.layout.width)
        std::copy_n(found.data() + map.layout.cell(row, 0), map.layout.width, region);
    return out;
}

Out<std::int32_t> distances(In<bool, 2> grid, In<std::int32_t, 2> cells) {
    const auto map = to_grid(grid);
    const auto& layout = map.layout;
    require(cells.shape(1) == 2, "cells must have shape (M, 2)");
    for (std::size_t i = 0; i < cells.shape(0); ++i)
        if (!layout.contains(cells(i, 0), cells(i, 1))) fail("cell " + std::to_string(i) + " lies outside the map");
    auto [steps, out] = make_array<std::int32_t>({cells.shape(0), grid.shape(0), grid.shape(1)});
    nb::gil_scoped_release release;
    std::vector<mapf::Distance> distance;
    std::vector<int> queue;
    std::int32_t* next = steps;
    for (std::size_t i = 0; i < cells.shape(0); ++i) {
        mapf::distances_to(map, layout.cell(cells(i, 0), cells(i, 1)), distance, queue);
        for (int row = 0; row < layout.height; ++row)
            for (int col = 0; col < layout.width; ++col) {
                const auto d = distance[layout.cell(row, col)];
                *next++ = d == mapf::unreachable ? -1 : d;
            }
    }
    return out;
}

Out<bool> random_maps(In<std::uint64_t, 1> seeds, int height, int width, int obstacles, int kind, int corridor_width,
                      double loops, int room_size, int shelf_length, int shelf_depth, int segments, double straight,
                      bool ring) {
    auto [grid, out] = make_array<bool>({seeds.shape(0), static_cast<std::size_t>(height), static_cast<std::size_t>(width)});
    require(kind >= 0 && kind <= static_cast<int>(mapf::Style::empty), "there is no such style");
    require(std::min({corridor_width, room_size, shelf_length, shelf_depth, segments}) >= 1, "the parts of a map have a size");
    const auto style = static_cast<mapf::Style>(kind);
    const mapf::Parts parts{corridor_width, loops, room_size, shelf_length, shelf_depth, segments, straight, ring};
    nb::gil_scoped_release release;
    for (std::size_t b = 0; b < seeds.shape(0); ++b) {
        mapf::Random random(mapf::seed_for(mapf::Use::map, seeds(b)));
        const auto map = mapf::random_map(style, parts, height, width, obstacles, random);
        write_obstacles(map, grid + b * height * width);
    }
    return out;
}

std::tuple<Out<std::int32_t>, Out<std::int32_t>> place_agents(In<std::uint64_t, 1> seeds, In<bool, 3> grids,
                                                              int num_agents) {
    require(grids.shape(0) == seeds.shape(0), "give one seed for each grid");
    const std::size_t N = num_agents;
    auto [starts, out_starts] = make_array<std::int32_t>({seeds.shape(0), N, 2});
    auto [goals, out_goals] = make_array<std::int32_t>({seeds.shape(0), N, 2});
    const int height = static_cast<int>(grids.shape(1)), width = static_cast<int>(grids.shape(2));
    nb::gil_scoped_release release;
    for (std::size_t b = 0; b < seeds.shape(0); ++b) {
        const mapf::Grid grid(reinterpret_cast<const std::uint8_t*>(grids.data()) + b * height * width, height, width);
        mapf::Random random(mapf::seed_for(mapf::Use::placement, seeds(b)));
        mapf::place_agents(grid, num_agents, random, starts + b * N * 2, goals + b * N * 2);
    }
    return {out_starts, out_goals};
}

template <class T>
void observe(In<T, 3> obstacles, int border, In<std::int32_t, 3> positions, In<std::int32_t, 3> goals, int radius,
             InOut<T, 5> out) {
    const auto layout = layout_of(obstacles, border);
    const std::size_t num_envs = obstacles.shape(0), num_agents = positions.shape(1), side = 2 * radius + 3;
    require(radius >= 1 && border >= radius, "obstacles need a border of at least the field of view's radius");
    require_on_map(positions, layout, num_envs, "positions");
    require_on_map(goals, layout, num_envs, "goals");
    require(goals.shape(1) == num_agents, "give one goal for each agent");
    require(out.shape(0) == num_envs && out.shape(1) == num_agents && out.shape(2) == mapf::num_channels &&
                out.shape(3) == side && out.shape(4) == side,
            "out must have shape (B, N, 3, 2 * radius + 3, 2 * radius + 3)");
    nb::gil_scoped_release release;
    std::vector<T> agents(layout.size(), T{0});
    for (std::size_t b = 0; b < num_envs; ++b)
        mapf::observe(layout, obstacles.data() + b * layout.size(), positions.data() + b * num_agents * 2,
                      goals.data() + b * num_agents * 2, static_cast<int>(num_agents), radius, mapf::num_channels,
                      agents.data(), out.data() + b * num_agents * mapf::num_channels * side * side);
}

void communication_graph(In<std::int32_t, 3> positions, In<double, 1> radius, bool by_distance, InOut<float, 3> out) {
    const std::size_t num_envs = positions.shape(0), num_agents = positions.shape(1);
    require(positions.shape(2) == 2, "positions must have shape (B, N, 2)");
    require(out.shape(0) == num_envs && out.shape(1) == num_agents && out.shape(2) == num_agents,
            "out must have shape (B, N, N)");
    require(radius.shape(0) == num_envs, "give one radius for each environment");
    const auto weights = by_distance ? mapf::Weights::distance : mapf::Weights::binary;
    nb::gil_scoped_release release;
    std::vector<float> rows, cols;
    for (std::size_t b = 0; b < num_envs; ++b)
        mapf::communication_graph(positions.data() + b * num_agents * 2, static_cast<int>(num_agents), radius(b), weights,
                                  static_cast<int>(num_agents), rows, cols, out.data() + b * num_agents * num_agents);
}

template <class T>
Out<std::int8_t> shield(In<T, 3> obstacles, int border, In<std::int32_t, 3> positions, In<std::int64_t, 2> actions,
                        In<std::uint64_t, 1> seeds, In<std::int64_t, 1> times) {
    const auto layout = layout_of(obstacles, border);
    const std::size_t num_envs = obstacles.shape(0), num_agents = positions.shape(1);
    require_on_map(positions, layout, num_envs, "positions");
    if (actions.shape(0) != num_envs || actions.shape(1) != num_agents)
        fail("actions must have shape " + shown({num_envs, num_agents}) + ", got " +
             shown({actions.shape(0), actions.shape(1)}));
    require(seeds.shape(0) == num_envs && times.shape(0) == num_envs, "give one seed and time for each environment");
    mapf::require_actions(actions.data(), num_envs, num_agents);
    auto [executed, out] = make_array<std::int8_t>({num_envs, num_agents});
    nb::gil_scoped_release release;
    mapf::ShieldScratch scratch(layout, static_cast<int>(num_agents));
    for (std::size_t b = 0; b < num_envs; ++b)
        mapf::shield(layout, obstacles.data() + b * layout.size(), positions.data() + b * num_agents * 2,
                     actions.data() + b * num_agents, static_cast<int>(num_agents),
                     mapf::mix(mapf::seed_for(mapf::Use::ties, seeds(b)), times(b)), scratch,
                     executed + b * num_agents);
    return out;
}

Out<std::int32_t> move(In<std::int32_t, 3> positions, In<std::int64_t, 2> actions) {
    require(positions.shape(0) == actions.shape(0) && positions.shape(1) == actions.shape(1) && positions.shape(2) == 2,
            "positions must have shape (B, N, 2) and actions (B, N)");
    auto [moved, out] = make_array<std::int32_t>({positions.shape(0), positions.shape(1), 2});
    mapf::require_actions(actions.data(), actions.shape(0), actions.shape(1));
    for (std::size_t i = 0; i < actions.size(); ++i) {
        const auto action = actions.data()[i];
        moved[2 * i] = positions.data()[2 * i] + mapf::row_step[action];
        moved[2 * i + 1] = positions.data()[2 * i + 1] + mapf::col_step[action];
    }
    return out;
}

template <class T>
Out<std::int8_t> action_mask(In<T, 3> obstacles, int border, In<std::int32_t, 3> positions) {
    const auto layout = layout_of(obstacles, border);
    const std::size_t num_envs = obstacles.shape(0), num_agents = positions.shape(1);
    require_on_map(positions, layout, num_envs, "positions");
    auto [mask, out] = make_array<std::int8_t>({num_envs, num_agents, mapf::num_actions});
    const auto steps = layout.steps();
    for (std::size_t i = 0; i < num_envs * num_agents; ++i) {
        const T* map = obstacles.data() + i / num_agents * layout.size();
        const int cell = layout.cell(positions.data()[2 * i], positions.data()[2 * i + 1]);
        for (int action = 0; action < mapf::num_actions; ++action) *mask++ = map[cell + steps[action]] == T{0};
    }
    return out;
}

Out<std::uint64_t> mix(In<std::uint64_t, 1> seeds, In<std::uint64_t, 1> counters) {
    require(seeds.shape(0) == counters.shape(0), "give one counter for each seed");
    auto [mixed, out] = make_array<std::uint64_t>({seeds.shape(0)});
    for (std::size_t i = 0; i < seeds.shape(0); ++i) mixed[i] = mapf::mix(seeds(i), counters(i));
    return out;
}

void lose_messages(InOut<float, 3> graph, double loss, In<std::uint64_t, 1> seeds, In<std::int64_t, 1> times) {
    const std::size_t num_envs = graph.shape(0), num_agents = graph.shape(1);
    require(graph.shape(2) == num_agents, "graph must have shape (B, N, N)");
    require(seeds.shape(0) == num_envs && times.shape(0) == num_envs, "give one seed and time for each environment");
    for (std::size_t b = 0; b < num_envs; ++b)
        mapf::lose_messages(static_cast<int>(num_agents), loss,
                            mapf::mix(mapf::seed_for(mapf::Use::messages, seeds(b)), times(b)),
                            static_cast<int>(num_agents), graph.data() + b * num_agents * num_agents);
}

double connecting_radius(In<std::int32_t, 2> positions, double radius) {
    require(positions.shape(1) == 2, "positions must have shape (N, 2)");
    require(radius > 0.0, "a radius that grows must be positive");
    return mapf::connecting_radius(positions.data(), static_cast<int>(positions.shape(0)), radius);
}

template <class T>
Out<mapf::Distance> distance_tables(In<T, 3> obstacles, int border, In<std::int32_t, 3> goals) {
    const auto layout = layout_of(obstacles, border);
    const std::size_t num_envs = obstacles.shape(0), num_agents = goals.shape(1), size = layout.size();
    require_on_map(goals, layout, num_envs, "goals");
    auto [tables, out] = make_array<mapf::Distance>({num_envs, num_agents, size});
    nb::gil_scoped_release release;
    std::vector<mapf::Distance> distance;
    std::vector<int> queue;
    for (std::size_t b = 0; b < num_envs; ++b) {
        const auto grid = mapf::grid_of(layout, obstacles.data() + b * size);
        for (std::size_t i = b * num_agents; i < (b + 1) * num_agents; ++i) {
            mapf::distances_to(grid, layout.cell(goals.data()[2 * i], goals.data()[2 * i + 1]), distance, queue);
            std::copy(distance.begin(), distance.end(), tables + i * size);
        }
    }
    return out;
}

template <class T>
Out<std::int8_t> pibt_shield(In<T, 3> obstacles, int border, In<std::int32_t, 3> positions, In<float, 3> scores,
                             In<std::int64_t, 2> actions, In<std::int32_t, 2> under_way, In<std::uint64_t, 1> seeds,
                             In<std::int64_t, 1> times, std::optional<In<std::int32_t, 3>> goals,
                             std::optional<In<mapf::Distance, 3>> distances) {
    const auto layout = layout_of(obstacles, border);
    const std::size_t num_envs = obstacles.shape(0), num_agents = positions.shape(1), size = layout.size();
    require_on_map(positions, layout, num_envs, "positions");
    const bool swap = goals.has_value() && distances.has_value();
    if (swap) {
        require_on_map(*goals, layout, num_envs, "goals");
        require(goals->shape(1) == num_agents && distances->shape(0) == num_envs &&
                    distances->shape(1) == num_agents && distances->shape(2) == size,
                "goals must have shape (B, N, 2) and distances be the distance tables of these goals");
    }
    const bool by_scores = scores.size() > 0;
    const std::size_t robots = by_scores ? scores.shape(1) : actions.shape(1);
    require((by_scores ? scores.shape(0) : actions.shape(0)) == num_envs && robots == num_agents,
            "actions must have shape (B, N) or, as scores of all five, (B, N, 5)");
    require(!by_scores || scores.shape(2) == mapf::num_actions, "scores of actions must have shape (B, N, 5)");
    for (std::size_t i = 0; i < scores.size(); ++i)
        require(!std::isnan(scores.data()[i]), "the scores of actions must be numbers");
    if (!by_scores) mapf::require_actions(actions.data(), num_envs, num_agents);
    require(under_way.shape(0) == num_envs && under_way.shape(1) == num_agents, "under_way must have shape (B, N)");
    require(seeds.shape(0) == num_envs && times.shape(0) == num_envs, "give one seed and time for each environment");
    auto [executed, out] = make_array<std::int8_t>({num_envs, num_agents});
    nb::gil_scoped_release release;
    mapf::PibtScratch<T> scratch(layout, static_cast<int>(num_agents));
    std::vector<int> goal_cells;
    for (std::size_t b = 0; b < num_envs; ++b) {
        const std::size_t first = b * num_agents;
        const std::uint64_t key = mapf::mix(mapf::seed_for(mapf::Use::preferences, seeds(b)), times(b));
        for (std::size_t i = 0; i < num_agents; ++i)
            if (by_scores)
                mapf::prefer_scores(scores.data() + (first + i) * mapf::num_actions,
                                    &scratch.preferences[i * mapf::num_actions]);
            else
                mapf::prefer_action(static_cast<int>(actions.data()[first + i]), mapf::mix(key, i),
                                    &scratch.preferences[i * mapf::num_actions]);
        const auto shield = [&](const auto& swaps) {
            mapf::pibt_shield(layout, obstacles.data() + b * size, positions.data() + first * 2,
                              under_way.data() + first, static_cast<int>(num_agents),
                              mapf::seed_for(mapf::Use::priorities, seeds(b)), scratch, executed + first, swaps);
        };
        if (!swap) {
            shield(mapf::NoSwaps{});
            continue;
        }
        goal_cells.clear();
        for (std::size_t i = first; i < first + num_agents; ++i)
            goal_cells.push_back(layout.cell(goals->data()[2 * i], goals->data()[2 * i + 1]));
        shield(mapf::TableSwaps{std::span<const int>(goal_cells),
                                [&](int robot) { return distances->data() + (first + robot) * size; }});
    }
    return out;
}

template <class T>
void draw_goals(In<T, 3> obstacles, int border, In<std::int32_t, 3> positions, InOut<std::int32_t, 3> goals,
                In<std::int32_t, 2> arrivals, In<bool, 2> arrived, In<std::uint64_t, 1> seeds) {
    const auto layout = layout_of(obstacles, border);
    const std::size_t num_envs = obstacles.shape(0), num_agents = positions.shape(1), size = layout.size();
    require_on_map(positions, layout, num_envs, "positions");
    require_on_map(goals, layout, num_envs, "goals");
    require(goals.shape(1) == num_agents, "give one goal for each agent");
    require(arrivals.shape(0) == num_envs && arrivals.shape(1) == num_agents && arrived.shape(0) == num_envs &&
                arrived.shape(1) == num_agents,
            "arrivals and arrived must have shape (B, N)");
    require(seeds.shape(0) == num_envs, "give one seed for each environment");
    std::vector<std::uint8_t> taken(size, 0);
    for (std::size_t b = 0; b < num_envs; ++b) {
        const auto regions = mapf::regions_of(mapf::grid_of(layout, obstacles.data() + b * size));
        auto* team = goals.data() + b * num_agents * 2;
        mapf::mark(layout, team, static_cast<int>(num_agents), std::uint8_t{1}, taken.data());
        for (std::size_t i = 0; i < num_agents; ++i)
            if (arrived(b, i))
                mapf::draw_goal(layout, regions.data(), positions.data() + (b * num_agents + i) * 2,
                                mapf::goal_random(seeds(b), static_cast<int>(i), arrivals(b, i)), taken.data(),
                                team + 2 * i);
        mapf::mark(layout, team, static_cast<int>(num_agents), std::uint8_t{0}, taken.data());
    }
}

// The kernels whose maps are stored as T, so that views are copied and not converted.
template <class T>
void define_for_dtype(nb::module_& m) {
    m.def("observe", &observe<T>, "obstacles"_a, "border"_a, "positions"_a, "goals"_a, "radius"_a, "out"_a.noconvert(),
          "Write every robot's field of view into out (B, N, 3, 2 * radius + 3, 2 * radius + 3).");
    m.def("shield", &shield<T>, "obstacles"_a, "border"_a, "positions"_a, "actions"_a, "seeds"_a, "times"_a,
          "(B, N) int8 actions that the paper's collision shield lets through; ties are drawn by seed and time.");
    m.def("action_mask", &action_mask<T>, "obstacles"_a, "border"_a, "positions"_a,
          "(B, N, 5) int8, 1 for each action that neither leaves the map nor enters an obstacle.");
    m.def("distance_tables", &distance_tables<T>, "obstacles"_a, "border"_a, "goals"_a,
          "(B, N, size) uint16 steps from each cell of the bordered map to each goal; 65535 where there is no way.");
    m.def("pibt_shield", &pibt_shield<T>, "obstacles"_a, "border"_a, "positions"_a, "scores"_a, "actions"_a,
          "under_way"_a, "seeds"_a, "times"_a, "goals"_a = nb::none(), "distances"_a = nb::none(),
          "(B, N) int8 actions by priority inheritance, from scores (B, N, 5) or, if these are empty, actions (B, N).");
    m.def("draw_goals", &draw_goals<T>, "obstacles"_a, "border"_a, "positions"_a, "goals"_a.noconvert(), "arrivals"_a,
          "arrived"_a, "seeds"_a, "Replace the goals (B, N, 2) of the robots that have arrived (B, N) by new ones.");
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Native kernels: distances, maps, shield, views and communication graphs, over batches.";
    m.def("regions", &regions, "grid"_a, "(H, W) int32 number of the region of each cell; -1 on obstacles.");
    m.def("distances", &distances, "grid"_a, "cells"_a,
          "(M, H, W) int32 steps from each cell to each of M free cells (M, 2); -1 where there is no way.");
    const mapf::Parts parts;
    m.def("random_maps", &random_maps, "seeds"_a, "height"_a, "width"_a, "obstacles"_a, "style"_a,
          "corridor_width"_a = parts.corridor_width, "loops"_a = parts.loops, "room_size"_a = parts.room_size,
          "shelf_length"_a = parts.shelf_length, "shelf_depth"_a = parts.shelf_depth, "segments"_a = parts.segments,
          "straight"_a = parts.straight, "ring"_a = parts.ring,
          "(B, H, W) bool maps with connected free cells, one for each seed; with that many obstacles if the style takes any.");
    m.def("place_agents", &place_agents, "seeds"_a, "grids"_a, "num_agents"_a,
          "Starts and goals (B, N, 2) int32, uniform over the largest connected region of each grid (B, H, W).");
    m.def("communication_graph", &communication_graph, "positions"_a, "radius"_a, "by_distance"_a,
          "out"_a.noconvert(),
          "Write who hears whom into out (B, N, N) float32: 1 or 1 / distance where two robots are closer than radius.");
    m.def("lose_messages", &lose_messages, "graph"_a.noconvert(), "loss"_a, "seeds"_a, "times"_a,
          "Set each weight of graph (B, N, N) to 0 with probability loss, drawn by seed and time.");
    m.def("connecting_radius", &connecting_radius, "positions"_a, "radius"_a,
          "The least radius * 1.1^k at which the robots (N, 2) are connected.");
    m.def("move", &move, "positions"_a, "actions"_a, "(B, N, 2) int32 positions after the actions (B, N) int64.");
    m.def("mix", &mix, "seeds"_a, "counters"_a, "(B,) uint64 hash of a seed and a counter.");
    mapf::define_perceive(m);
    mapf::define_stepper(m);
    define_for_dtype<float>(m);
    define_for_dtype<std::uint8_t>(m);
}
