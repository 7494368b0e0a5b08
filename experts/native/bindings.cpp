// Python's view of the solvers: arrays become problems, outcomes become tuples, Ctrl-C becomes an interrupt.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <numeric>
#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>

#include "experts/native/ecbs.hpp"
#include "experts/native/improvement.hpp"
#include "experts/native/labels.hpp"
#include "experts/native/lazy_constraints.hpp"
#include "experts/native/neighbourhood_search.hpp"
#include "experts/native/priority_inheritance.hpp"
#include "experts/native/prioritised_planning.hpp"
#include "experts/native/relabelling.hpp"
#include "experts/native/rolling_horizon.hpp"
#include "experts/native/work_queue.hpp"
#include "mapf_env/native/arrays.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using mapf::In;
using mapf::Out;

using GridArray = In<bool, 2>;
using CellsArray = In<std::int32_t, 2>;
using InstanceArrays = std::tuple<GridArray, CellsArray, CellsArray>;

// The parts of Python's Result: status, paths, cost, lower bound, expansions, generated, seconds, found by.
using ResultParts = std::tuple<int, std::optional<Out<std::int32_t>>, std::int64_t, std::int64_t, std::size_t,
                               std::size_t, double, int>;

mapf::Grid as_grid(const GridArray& grid) {
    return {reinterpret_cast<const std::uint8_t*>(grid.data()), static_cast<int>(grid.shape(0)),
            static_cast<int>(grid.shape(1))};
}

std::vector<int> as_cells(const mapf::Layout& layout, const CellsArray& cells) {
    std::vector<int> flat(cells.shape(0));
    for (std::size_t robot = 0; robot < flat.size(); ++robot)
        flat[robot] = layout.cell(cells(robot, 0), cells(robot, 1));
    return flat;
}

// Runs `search(interrupt)` without the GIL; raises KeyboardInterrupt if a signal came meanwhile.
template <class Search>
void run_without_gil(const Search& search) {
    mapf::Interrupt interrupt([] {
        const nb::gil_scoped_acquire acquire;
        return PyErr_CheckSignals() != 0;
    });
    {
        const nb::gil_scoped_release release;
        search(interrupt);
    }
    if (PyErr_Occurred()) throw nb::python_error();
}

struct Outcome {
    mapf::Status status = mapf::Status::time_limit;
    std::vector<std::int32_t> paths;  // (T + 1, N, 2), empty without a plan
    std::int64_t cost = 0, lower_bound = 0;
    std::size_t expansions = 0, generated = 0;
    double seconds = 0;
    mapf::FoundBy found_by = mapf::FoundBy::none;
};

struct Workspace {
    mapf::DistanceTables distances;
    mapf::Ecbs ecbs;
};

// Writes the (T + 1, N, 2) paths of robots that start in `starts`; action_of(robot, time) is the step that ends then.
template <class ActionOf>
std::vector<std::int32_t> write_paths(const mapf::Layout& layout, std::vector<int> cells, int makespan,
                                      const ActionOf& action_of) {
    const auto steps = layout.steps();
    std::vector<std::int32_t> paths;
    paths.reserve(static_cast<std::size_t>(makespan + 1) * cells.size() * 2);
    for (int time = 0; time <= makespan; ++time)
        for (std::size_t robot = 0; robot < cells.size(); ++robot) {
            if (time > 0) cells[robot] += steps[action_of(robot, time)];
            paths.push_back(layout.row(cells[robot]));
            paths.push_back(layout.col(cells[robot]));
        }
    return paths;
}

// Writes the paths and the cost of a plan: plan.actions(robot) until it arrives.
template <class Plan>
void write_plan(const mapf::Layout& layout, const std::vector<int>& starts, const Plan& plan, Outcome& outcome) {
    int makespan = 0;
    outcome.cost = 0;
    for (std::size_t robot = 0; robot < starts.size(); ++robot) {
        const auto arrival_time = static_cast<int>(plan.actions(robot).size());
        makespan = std::max(makespan, arrival_time);
        outcome.cost += arrival_time;
    }
    outcome.paths = write_paths(layout, starts, makespan, [&](std::size_t robot, int time) {
        const auto actions = plan.actions(robot);
        return time <= static_cast<int>(actions.size()) ? static_cast<int>(actions[time - 1]) : mapf::idle;
    });
}

std::int64_t sum_of_distances(const mapf::Problem& problem) {
    std::int64_t sum = 0;
    for (std::size_t robot = 0; robot < problem.starts.size(); ++robot)
        sum += problem.distances.to_goal_of(robot)[problem.starts[robot]];
    return sum;
}

Outcome run_ecbs(const InstanceArrays& arrays, const mapf::EcbsOptions& options, double time_limit,
                 Workspace& workspace, mapf::Interrupt& interrupt, bool polls) {
    mapf::Budget budget(time_limit, interrupt, polls);
    const auto grid = as_grid(std::get<0>(arrays));
    const auto starts = as_cells(grid.layout, std::get<1>(arrays)), goals = as_cells(grid.layout, std::get<2>(arrays));
    Outcome outcome;
    if (workspace.distances.compute(grid, goals, budget)) {
        auto& ecbs = workspace.ecbs;
        outcome.status = ecbs.solve({grid, starts, goals, workspace.distances}, options, budget);
        outcome.lower_bound = ecbs.lower_bound();
        outcome.expansions = ecbs.expansions();
        outcome.generated = ecbs.generated();
        if (ecbs.has_plan()) {
            write_plan(grid.layout, starts, ecbs, outcome);
            outcome.found_by = ecbs.found_by();
        }
    }
    outcome.seconds = budget.seconds();
    return outcome;
}

ResultParts as_parts(const Outcome& outcome, std::size_t num_robots) {
    std::optional<Out<std::int32_t>> paths;
    if (!outcome.paths.empty()) {
        auto [data, array] = mapf::make_array<std::int32_t>({outcome.paths.size() / (2 * num_robots), num_robots, 2});
        std::copy(outcome.paths.begin(), outcome.paths.end(), data);
        paths = array;
    }
    return {static_cast<int>(outcome.status), paths, outcome.cost, outcome.lower_bound, outcome.expansions,
            outcome.generated, outcome.seconds, static_cast<int>(outcome.found_by)};
}

std::vector<ResultParts> ecbs(const std::vector<InstanceArrays>& instances, double w, double time_limit,
                              std::size_t node_limit, std::uint64_t seed, int threads) {
    std::vector<Outcome> outcomes(instances.size());
    run_without_gil([&](mapf::Interrupt& interrupt) {
        mapf::run_jobs<Workspace>(
            instances.size(), threads, interrupt, [&](std::size_t job, Workspace& workspace, bool polls) {
                outcomes[job] =
                    run_ecbs(instances[job], {w, node_limit, seed}, time_limit, workspace, interrupt, polls);
            });
    });
    std::vector<ResultParts> results;
    results.reserve(outcomes.size());
    for (std::size_t i = 0; i < outcomes.size(); ++i)
        results.push_back(as_parts(outcomes[i], std::get<1>(instances[i]).shape(0)));
    return results;
}

std::pair<Out<std::int8_t>, Out<bool>> relabel(const std::vector<std::pair<GridArray, CellsArray>>& problems,
                                               In<std::int64_t, 1> problem_of, In<std::int32_t, 2> positions,
                                               In<std::int64_t, 1> offsets, double w, std::size_t node_limit,
                                               std::uint64_t seed, int threads) {
    const std::size_t num_states = problem_of.shape(0);
    auto [actions, actions_array] = mapf::make_array<std::int8_t>({positions.shape(0)});
    auto [solved, solved_array] = mapf::make_array<bool>({num_states});
    std::vector<mapf::GoalsOnGrid> goals;
    goals.reserve(problems.size());
    for (const auto& [grid, cells] : problems) {
        auto map = as_grid(grid);
        auto flat = as_cells(map.layout, cells);
        goals.push_back({std::move(map), std::move(flat)});
    }
    const mapf::States states{num_states, positions.data(), offsets.data(), problem_of.data()};
    run_without_gil([&, actions = actions, solved = solved](mapf::Interrupt& interrupt) {
        mapf::relabel(goals, states, {w, node_limit, seed}, threads, interrupt, actions, solved);
    });
    return {actions_array, solved_array};
}

// The parts of Python's PlanLabels: source, time, offsets, positions, actions, solved, cost, found by.
using LabelParts = std::tuple<Out<std::int64_t>, Out<std::int32_t>, Out<std::int64_t>, Out<std::int32_t>,
                              Out<std::int8_t>, Out<bool>, Out<std::int64_t>, std::vector<int>>;

std::vector<mapf::Team> as_teams(const std::vector<InstanceArrays>& instances) {
    std::vector<mapf::Team> teams;
    teams.reserve(instances.size());
    for (const auto& [grid, starts, goals] : instances) {
        auto map = as_grid(grid);
        auto from = as_cells(map.layout, starts), to = as_cells(map.layout, goals);
        teams.push_back({std::move(map), std::move(from), std::move(to)});
    }
    return teams;
}

LabelParts label_plans(const std::vector<InstanceArrays>& instances, int steps, double w, std::size_t node_limit,
                       int rounds, std::uint64_t seed, int threads) {
    const auto teams = as_teams(instances);
    std::vector<mapf::PlanLabels> labels;
    run_without_gil([&](mapf::Interrupt& interrupt) {
        labels = mapf::label_plans(teams, {steps, w, node_limit, rounds, seed}, threads, interrupt);
    });
    std::size_t num_states = 0, num_robots = 0;
    for (std::size_t i = 0; i < teams.size(); ++i) {
        num_states += static_cast<std::size_t>(labels[i].steps);
        num_robots += static_cast<std::size_t>(labels[i].steps) * teams[i].starts.size();
    }
    auto [source, source_array] = mapf::make_array<std::int64_t>({num_states});
    auto [time, time_array] = mapf::make_array<std::int32_t>({num_states});
    auto [offset, offsets_array] = mapf::make_array<std::int64_t>({num_states + 1});
    auto [position, positions_array] = mapf::make_array<std::int32_t>({num_robots, 2});
    auto [action, actions_array] = mapf::make_array<std::int8_t>({num_robots});
    auto [solved, solved_array] = mapf::make_array<bool>({teams.size()});
    auto [cost, cost_array] = mapf::make_array<std::int64_t>({teams.size()});
    std::vector<int> found_by;
    *offset = 0;
    for (std::size_t i = 0; i < teams.size(); ++i) {
        const auto& layout = teams[i].grid.layout;
        const auto directions = layout.steps();
        auto cells = teams[i].starts;
        auto next = labels[i].actions.begin();
        solved[i] = labels[i].found_by != mapf::FoundBy::none;
        cost[i] = labels[i].cost;
        found_by.push_back(static_cast<int>(labels[i].found_by));
        for (int at = 0; at < labels[i].steps; ++at) {
            *source++ = static_cast<std::int64_t>(i);
            *time++ = at;
            offset[1] = offset[0] + static_cast<std::int64_t>(cells.size());
            ++offset;
            for (auto& cell : cells) {
                *position++ = layout.row(cell);
                *position++ = layout.col(cell);
                *action++ = static_cast<std::int8_t>(*next);
                cell += directions[*next++];
            }
        }
    }
    return {source_array, time_array, offsets_array, positions_array, actions_array, solved_array, cost_array, found_by};
}

Out<std::int8_t> next_moves(const std::vector<InstanceArrays>& instances, int window, int rounds, std::uint64_t seed,
                            int threads) {
    const auto teams = as_teams(instances);
    std::size_t num_robots = 0;
    for (const auto& each : teams) num_robots += each.starts.size();
    auto [move, array] = mapf::make_array<std::int8_t>({num_robots});
    std::vector<std::vector<std::uint8_t>> found;
    run_without_gil([&](mapf::Interrupt& interrupt) {
        found = mapf::next_moves(teams, window, rounds, seed, threads, interrupt);
    });
    for (const auto& moves : found) move = std::copy(moves.begin(), moves.end(), move);
    return array;
}

// One search in the calling thread: search(problem's grid, starts, goals, budget, outcome).
template <class Search>
ResultParts run_one(const GridArray& grid_array, const CellsArray& start_cells, const CellsArray& goal_cells,
                    double time_limit, const Search& search) {
    Outcome outcome;
    run_without_gil([&](mapf::Interrupt& interrupt) {
        mapf::Budget budget(time_limit, interrupt, true);
        const auto grid = as_grid(grid_array);
        search(grid, as_cells(grid.layout, start_cells), as_cells(grid.layout, goal_cells), budget, outcome);
        outcome.seconds = budget.seconds();
    });
    return as_parts(outcome, start_cells.shape(0));
}

ResultParts pibt(const GridArray& grids, const CellsArray& start_cells, const CellsArray& goal_cells, bool swap,
                 int max_steps, std::uint64_t seed) {
    constexpr double no_limit = std::numeric_limits<double>::infinity();
    return run_one(grids, start_cells, goal_cells, no_limit, [&](const mapf::Grid& grid, const std::vector<int>& starts,
                                                                 const std::vector<int>& goals, mapf::Budget& budget,
                                                                 Outcome& outcome) {
        mapf::DistanceTables distances;
        if (!distances.compute(grid, goals, budget)) return;
        const mapf::Problem problem{grid, starts, goals, distances};
        const auto run = mapf::run_pibt(problem, swap, max_steps, seed, budget);
        const auto num_robots = starts.size();
        const int steps = static_cast<int>(run.actions.size() / num_robots);
        outcome.expansions = outcome.generated = static_cast<std::size_t>(steps);
        outcome.lower_bound = sum_of_distances(problem);
        outcome.status = run.solved ? mapf::Status::solved : mapf::Status::step_limit;
        if (!run.solved) return;
        outcome.found_by = mapf::FoundBy::pibt;
        outcome.cost = std::accumulate(run.arrival_times.begin(), run.arrival_times.end(), std::int64_t{0});
        outcome.paths = write_paths(grid.layout, starts, steps, [&](std::size_t robot, int time) {
            return run.actions[static_cast<std::size_t>(time - 1) * num_robots + robot];
        });
    });
}

ResultParts prioritised(const GridArray& grids, const CellsArray& start_cells, const CellsArray& goal_cells,
                        int max_orders, double time_limit, std::uint64_t seed) {
    return run_one(grids, start_cells, goal_cells, time_limit,
                   [&](const mapf::Grid& grid, const std::vector<int>& starts, const std::vector<int>& goals,
                       mapf::Budget& budget, Outcome& outcome) {
                       mapf::DistanceTables distances;
                       if (!distances.compute(grid, goals, budget)) return;
                       const mapf::Problem problem{grid, starts, goals, distances};
                       mapf::PrioritisedPlanning planning;
                       outcome.lower_bound = sum_of_distances(problem);
                       outcome.status = planning.run(problem, max_orders, seed, budget);
                       outcome.expansions = outcome.generated = planning.orders();
                       if (outcome.status != mapf::Status::solved) return;
                       write_plan(grid.layout, starts, planning, outcome);
                       outcome.found_by = mapf::FoundBy::prioritised;
                   });
}

ResultParts lacam(const GridArray& grids, const CellsArray& start_cells, const CellsArray& goal_cells, double w,
                  double time_limit, std::size_t node_limit, std::uint64_t seed) {
    return run_one(grids, start_cells, goal_cells, time_limit,
                   [&](const mapf::Grid& grid, const std::vector<int>& starts, const std::vector<int>& goals,
                       mapf::Budget& budget, Outcome& outcome) {
                       mapf::Lacam search(grid, starts, goals, seed);
                       outcome.status = search.run(mapf::Lacam::limits_of(node_limit), budget);
                       outcome.lower_bound = search.lower_bound();
                       outcome.expansions = search.expansions();
                       outcome.generated = search.generated();
                       if (outcome.status != mapf::Status::solved) return;
                       auto plan = search.plan();
                       outcome.found_by = mapf::FoundBy::lacam;
                       const auto target = mapf::cost_limit(w, outcome.lower_bound);
                       mapf::DistanceTables distances;
                       if (plan.cost() > target && distances.compute(grid, goals, budget)) {
                           mapf::NeighbourhoodSearch neighbourhoods;
                           const mapf::Problem problem{grid, starts, goals, distances};
                           constexpr int all = std::numeric_limits<int>::max();
                           if (mapf::improve(problem, target, all, seed, plan, neighbourhoods, budget))
                               outcome.found_by = mapf::FoundBy::improvement;
                       }
                       write_plan(grid.layout, starts, plan, outcome);
                   });
}

[[noreturn]] void reject_robot(const char* array, std::size_t robot, int row, int col, const char* what) {
    throw std::invalid_argument(std::string(array) + "[" + std::to_string(robot) + "]: agent " + std::to_string(robot) +
                                " at (" + std::to_string(row) + ", " + std::to_string(col) + ") " + what);
}

// The cells of the robots; throws std::invalid_argument if one lies off the map or on an obstacle.
std::vector<int> checked_cells(const mapf::Grid& grid, const CellsArray& cells, const char* name) {
    for (std::size_t robot = 0; robot < cells.shape(0); ++robot) {
        const int row = cells(robot, 0), col = cells(robot, 1);
        if (!grid.layout.contains(row, col)) reject_robot(name, robot, row, col, "lies outside the map");
        if (grid.blocked[grid.layout.cell(row, col)]) reject_robot(name, robot, row, col, "lies on an obstacle");
    }
    return as_cells(grid.layout, cells);
}

// Plans on; the joint actions (window, N) of the plan.
Out<std::int8_t> plan_window(mapf::RollingHorizon& planner, const CellsArray& positions, const CellsArray& goals,
                             int executed) {
    const auto cells = checked_cells(planner.grid(), positions, "positions");
    const auto targets = checked_cells(planner.grid(), goals, "goals");
    const auto num_robots = cells.size();
    std::vector<std::uint8_t> taken(planner.grid().blocked.size(), 0);
    for (std::size_t robot = 0; robot < num_robots; ++robot)
        if (std::exchange(taken[cells[robot]], std::uint8_t{1}))
            reject_robot("positions", robot, positions(robot, 0), positions(robot, 1), "shares its cell with another agent");
    const auto window = static_cast<std::size_t>(planner.window());
    auto [data, array] = mapf::make_array<std::int8_t>({window, num_robots});
    run_without_gil([&, data = data](mapf::Interrupt& interrupt) {
        mapf::Budget budget(std::numeric_limits<double>::infinity(), interrupt, true);
        for (std::size_t robot = 0; robot < num_robots; ++robot)
            if (!planner.reaches(cells[robot], targets[robot]))
                reject_robot("positions", robot, positions(robot, 0), positions(robot, 1),
                             "cannot reach its goal: obstacles separate them");
        planner.plan(cells, targets, executed, budget);
        for (std::size_t time = 0; time < window; ++time)
            for (std::size_t robot = 0; robot < num_robots; ++robot)
                data[time * num_robots + robot] =
                    static_cast<std::int8_t>(planner.action(robot, static_cast<int>(time)));
    });
    return array;
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Native solvers: arguments are checked in Python, statuses are the positions of the members of Status.";
    m.def("ecbs", &ecbs, "instances"_a, "w"_a, "time_limit"_a, "node_limit"_a, "seed"_a, "threads"_a,
          "Solves each instance (grid, starts, goals); see experts.solve_many.");
    m.def("relabel", &relabel, "problems"_a, "problem_of"_a, "positions"_a, "offsets"_a, "w"_a, "node_limit"_a, "seed"_a,
          "threads"_a, "First joint action for each state; see experts.relabel.");
    m.def("label_plans", &label_plans, "instances"_a, "steps"_a, "w"_a, "node_limit"_a, "rounds"_a, "seed"_a,
          "threads"_a, "Solves each instance once and labels the states on its plan; see experts.label_plans.");
    m.def("next_moves", &next_moves, "instances"_a, "window"_a, "rounds"_a, "seed"_a, "threads"_a,
          "The first joint action of a plan with a rolling horizon for each instance; see experts.next_moves.");
    nb::class_<mapf::RollingHorizon>(m, "RollingHorizon", "Plans a few steps ahead; see experts.RollingHorizon.")
        .def("__init__",
             [](mapf::RollingHorizon* self, const GridArray& grid, int window, int rounds, std::uint64_t seed) {
                 new (self) mapf::RollingHorizon(as_grid(grid), window, rounds, seed);
             },
             "grid"_a, "window"_a, "rounds"_a, "seed"_a)
        .def("plan", &plan_window, "positions"_a, "goals"_a, "executed"_a,
             "Joint actions (window, N), after `executed` steps of the last plan.");
    m.def("pibt", &pibt, "grid"_a, "starts"_a, "goals"_a, "swap"_a, "max_steps"_a, "seed"_a,
          "Runs PIBT; see experts.pibt.");
    m.def("prioritised", &prioritised, "grid"_a, "starts"_a, "goals"_a, "max_orders"_a, "time_limit"_a, "seed"_a,
          "Prioritised planning; see experts.prioritised.");
    m.def("lacam", &lacam, "grid"_a, "starts"_a, "goals"_a, "w"_a, "time_limit"_a, "node_limit"_a, "seed"_a,
          "LaCAM; see experts.lacam.");
}
