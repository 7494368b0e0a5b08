#include "mapf_env/native/perceive.hpp"

#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <string>
#include <vector>

#include "mapf_env/native/arrays.hpp"
#include "mapf_env/native/bag.hpp"
#include "mapf_env/native/checks.hpp"
#include "mapf_env/native/observe.hpp"
#include "mapf_env/native/pool.hpp"
#include "mapf_env/native/team_step.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace mapf {

Senses senses_of(nb::handle config) {
    const auto names = [&](const char* field) { return nb::cast<std::vector<std::string>>(config.attr(field)); };
    const bool by_distance = nb::cast<std::string>(config.attr("comm_weights")) == "distance";
    return {nb::cast<int>(config.attr("fov_radius")),
            nb::cast<int>(config.attr("memory")),
            by_distance ? Weights::distance : Weights::binary,
            names("extra_channels"),
            names("robot_features"),
            names("edge_features")};
}

namespace {

// The tables of senses.cpp as lists of tuples, in the order of the fields of their rows without the kernels.
nb::list channel_rows(int fov_radius) {
    nb::list rows;
    for (const Channel& row : channels())
        rows.append(nb::make_tuple(row.name, row.low, row.high, row.unit(fov_radius), row.needs_map, row.needs_history));
    return rows;
}

template <class Row>
nb::list feature_rows(std::span<const Row> table, int memory) {
    nb::list rows;
    for (const Row& row : table)
        rows.append(nb::make_tuple(row.name, row.width(memory), row.low, row.high, row.needs_map, row.needs_history));
    return rows;
}

// Maps of any sizes inside borders of `border` obstacles, one after the other in one array.
template <class T>
struct Maps {
    In<T, 1> cells;
    In<std::int64_t, 1> offsets;  // (M)
    In<std::int32_t, 2> sizes;    // (M, 2) height and width
    int border;

    Layout layout(std::size_t map) const { return {sizes(map, 0), sizes(map, 1), border}; }
    const T* obstacles(std::size_t map) const { return cells.data() + offsets(map); }
};

// Joint states of T teams; robots of team t are the rows offsets[t]..offsets[t + 1].
struct TeamStates {
    In<std::int32_t, 1> maps;
    In<std::int64_t, 1> offsets;
    In<std::int32_t, 2> positions, goals;
    In<std::int8_t, 2> moves;
    In<std::int32_t, 1> under_way;
    In<std::uint64_t, 1> seeds;
    In<std::int32_t, 1> times, limits;
    In<double, 1> comm_radius;

    std::size_t size() const { return maps.shape(0); }
    std::size_t robots(std::size_t t) const { return offsets(t + 1) - offsets(t); }
};

std::string cell_text(const std::int32_t* cell) {
    return "(" + std::to_string(cell[0]) + ", " + std::to_string(cell[1]) + ")";
}

// Throws what is wrong with a robot of team t: its cell, its goal, or that another robot stands on its cell.
template <class T>
[[noreturn]] void fail_at(const Layout& layout, const T* obstacles, const std::int32_t* positions,
                          const std::int32_t* goals, std::size_t robot, std::size_t t) {
    const std::string name = "robot " + std::to_string(robot) + " of team " + std::to_string(t);
    for (const std::int32_t* cells : {positions, goals}) {
        const std::int32_t* cell = cells + 2 * robot;
        const std::string text = (cells == goals ? "the goal of " : "") + name + " at " + cell_text(cell);
        if (!layout.contains(cell[0], cell[1])) fail(text + " lies outside the map");
        if (obstacles[layout.cell(cell[0], cell[1])] != T{0}) fail(text + " lies on an obstacle");
    }
    fail("two robots of team " + std::to_string(t) + " stand at " + cell_text(positions + 2 * robot));
}

// Throws where a state does not fit to its map; all kernels rely on it.
template <class T>
void require_sound(const Maps<T>& maps, const TeamStates& states, const Senses& senses) {
    const std::size_t count = states.size(), R = states.positions.shape(0), num_maps = maps.offsets.shape(0);
    require(maps.border >= senses.fov_radius, "the maps need a border of at least fov_radius: make the MapSet with a larger one");
    require(maps.sizes.shape(0) == num_maps && maps.sizes.shape(1) == 2, "give a height and width for each map");
    require(states.offsets.shape(0) == count + 1 && states.offsets(0) == 0, "offsets must have shape (T + 1,) and begin with 0");
    for (std::size_t t = 0; t < count; ++t)
        if (states.offsets(t + 1) < states.offsets(t)) fail("offsets must not fall, as they do after team " + std::to_string(t));
    if (static_cast<std::size_t>(states.offsets(count)) != R)
        fail("offsets end with " + std::to_string(states.offsets(count)) + ", but there are " + std::to_string(R) + " robots");
    require(states.positions.shape(1) == 2 && states.goals.shape(0) == R && states.goals.shape(1) == 2,
            "positions and goals must have shape (R, 2)");
    require(states.moves.shape(0) == R && states.moves.shape(1) == history, "moves must have shape (R, 16)");
    require(states.under_way.shape(0) == R, "under_way must have shape (R,)");
    require(states.seeds.shape(0) == count && states.times.shape(0) == count && states.limits.shape(0) == count &&
                states.comm_radius.shape(0) == count,
            "seeds, times, limits and comm_radius must have shape (T,)");
    const std::int8_t* const moves = states.moves.data();
    const std::size_t num_moves = R * history;
    std::uint8_t most = 0;  // of moves counted from -1, which compilers find with wide registers
    for (std::size_t i = 0; i < num_moves; ++i) most = std::max(most, static_cast<std::uint8_t>(moves[i] + 1));
    if (most > num_actions) {
        const auto is_none = [](std::int8_t move) { return static_cast<std::uint8_t>(move + 1) > num_actions; };
        const auto i = static_cast<std::size_t>(std::find_if(moves, moves + num_moves, is_none) - moves);
        fail("moves must lie in -1..4, got " + std::to_string(moves[i]) + " for robot " + std::to_string(i / history));
    }
    std::vector<std::uint8_t> taken;
    for (std::size_t t = 0; t < count; ++t) {
        const auto where = [t] { return " of team " + std::to_string(t); };
        if (static_cast<std::uint32_t>(states.maps(t)) >= num_maps)
            fail("the map" + where() + " is number " + std::to_string(states.maps(t)) + ", but there are " +
                 std::to_string(num_maps) + " maps");
        if (states.limits(t) < 1) fail("the limit" + where() + " must be at least 1");
        if (!(states.comm_radius(t) >= 0.0)) fail("the comm_radius" + where() + " must not be negative");
        const Layout layout = maps.layout(states.maps(t));
        const std::int64_t first_cell = maps.offsets(states.maps(t)), margin = 2 * maps.border;
        require(layout.height > 0 && layout.width > 0 && first_cell >= 0 &&
                    first_cell + (layout.height + margin) * (layout.width + margin) <=
                        static_cast<std::int64_t>(maps.cells.size()),
                "the maps do not fit into their memory");
        const T* obstacles = maps.obstacles(states.maps(t));
        if (taken.size() < static_cast<std::size_t>(layout.size())) taken.resize(layout.size(), 0);
        const std::size_t first = states.offsets(t), n = states.robots(t);
        const std::int32_t* const positions = states.positions.data() + 2 * first;
        const std::int32_t* const goals = states.goals.data() + 2 * first;
        // One pass without messages; what is wrong is looked for only where something is.
        std::size_t sound = 0;
        for (; sound < n; ++sound) {
            const std::int32_t *here = positions + 2 * sound, *goal = goals + 2 * sound;
            if (!layout.contains(here[0], here[1]) || !layout.contains(goal[0], goal[1])) break;
            const int cell = layout.cell(here[0], here[1]);
            if (obstacles[cell] != T{0} || obstacles[layout.cell(goal[0], goal[1])] != T{0} || taken[cell]) break;
            taken[cell] = 1;
        }
        if (sound < n) fail_at(layout, obstacles, positions, goals, sound, t);
        for (std::size_t i = 0; i < n; ++i) taken[layout.cell(positions[2 * i], positions[2 * i + 1])] = 0;
    }
}

// Memory of one thread for the teams of a bag.
template <class T>
struct alignas(64) BagScratch {
    std::vector<T> marks;
    std::vector<int> standing, order, ends;
    GoalSearch<T> search;
    std::vector<Distance> tables;
    std::vector<std::int32_t> corners;
    std::vector<std::uint8_t> greedy;
};

template <class T>
nb::tuple perceive_states(const Maps<T>& maps, const TeamStates& states, const Senses& senses, double message_loss,
                          int threads) {
    require(threads >= 1, "threads must be at least 1");
    std::vector<BagScratch<T>> scratch(threads);
    {
        nb::gil_scoped_release release;
        require_sound(maps, states, senses);
        std::size_t largest = 0;
        for (std::size_t t = 0; t < states.size(); ++t)
            largest = std::max<std::size_t>(largest, maps.layout(states.maps(t)).size());
        for (auto& each : scratch) each.marks.assign(largest, T{0});
    }
    const auto team_of = [&](std::size_t t, int part, bool needs_map) -> BagTeam<T> {
        auto& own = scratch[part];
        const std::size_t first = states.offsets(t), map = states.maps(t);
        TeamFacts team;
        team.layout = maps.layout(map);
        team.num_agents = static_cast<int>(states.robots(t));
        team.positions = states.positions.data() + 2 * first;
        team.goals = states.goals.data() + 2 * first;
        team.moves = states.moves.data() + first * history;
        team.under_way = states.under_way.data() + first;
        team.seed = states.seeds(t);
        team.time = states.times(t);
        team.limit = states.limits(t);
        team.comm_radius = states.comm_radius(t);
        if (needs_map) {
            const int side = 2 * senses.fov_radius + 1;
            const TableShape shape{side, side};
            own.tables.resize(team.num_agents * shape.size());
            own.corners.resize(2 * static_cast<std::size_t>(team.num_agents));
            own.search.on(team.layout, maps.obstacles(map));
            for (int i = 0; i < team.num_agents; ++i)
                own.search.fill(team.goal(i), team.positions[2 * i], team.positions[2 * i + 1], shape,
                                &own.corners[2 * i], &own.tables[i * shape.size()]);
            team.ways = {own.tables.data(), own.corners.data(), shape};
            find_greedy_moves(team, own.greedy);
            team.greedy = own.greedy.data();
        }
        team.order = order_by_tile(team.layout, team.positions, team.num_agents, own.order, own.ends);
        return {team, maps.obstacles(map), own.marks.data(), own.standing};
    };
    std::unique_ptr<Pool> pool;
    const auto for_each = [&](std::size_t count, const auto& job) {
        if (threads == 1) {
            for (std::size_t t = 0; t < count; ++t) job(t, 0);
            return;
        }
        if (!pool) pool = std::make_unique<Pool>(threads);
        pool->for_each(count, job);
    };
    return make_bag<T>(
        senses, message_loss, states.size(), [&](std::size_t t) { return states.robots(t); }, team_of,
        [](std::size_t t) { return t; }, [&](std::size_t t) { return message_key(states.seeds(t), states.times(t)); },
        for_each);
}

template <class T>
void define_for_dtype(nb::module_& m) {
    m.def(
        "perceive",
        [](In<T, 1> cells, In<std::int64_t, 1> map_offsets, In<std::int32_t, 2> map_sizes, int border,
           In<std::int32_t, 1> maps, In<std::int64_t, 1> offsets, In<std::int32_t, 2> positions,
           In<std::int32_t, 2> goals, In<std::int8_t, 2> moves, In<std::int32_t, 1> under_way,
           In<std::uint64_t, 1> seeds, In<std::int32_t, 1> times, In<std::int32_t, 1> limits,
           In<double, 1> comm_radius, nb::handle senses, double message_loss, int threads) {
            return perceive_states<T>(
                {cells, map_offsets, map_sizes, border},
                {maps, offsets, positions, goals, moves, under_way, seeds, times, limits, comm_radius},
                senses_of(senses), message_loss, threads);
        },
        "cells"_a, "map_offsets"_a, "map_sizes"_a, "border"_a, "maps"_a, "offsets"_a, "positions"_a, "goals"_a, "moves"_a,
        "under_way"_a, "seeds"_a, "times"_a, "limits"_a, "comm_radius"_a, "senses"_a, "message_loss"_a, "threads"_a,
        "The bag (fov, scalars, edge_index, edge_weight, edge_attr, team) of joint states on maps of any sizes.");
}

}  // namespace

void define_perceive(nb::module_& m) {
    m.attr("HISTORY") = history;
    m.def("channels", &channel_rows, "fov_radius"_a,
          "(name, low, high, unit, needs_map, needs_history) of each channel of the views, the paper's three first.");
    m.def("robot_features", [](int memory) { return feature_rows(robot_features(), memory); }, "memory"_a,
          "(name, width, low, high, needs_map, needs_history) of each feature of a robot.");
    m.def("edge_features", [](int memory) { return feature_rows(edge_features(), memory); }, "memory"_a,
          "(name, width, low, high, needs_map, needs_history) of each feature of an edge.");
    define_for_dtype<float>(m);
    define_for_dtype<std::uint8_t>(m);
}

}  // namespace mapf
