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
#include <tuple>

#include "experts/native/ecbs.hpp"
#include "experts/native/lacam.hpp"
#include "experts/native/neighbourhood_search.hpp"
#include "experts/native/pibt.hpp"
#include "experts/native/prioritised.hpp"
#include "experts/native/relabel.hpp"
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

// What Python's Result is made of: status, paths, cost, lower bound, expansions, generated, seconds.
using ResultParts =
    std::tuple<int, std::optional<Out<std::int32_t>>, std::int64_t, std::int64_t, std::size_t, std::size_t, double>;

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
    std::vector<std::int32_t> paths;  // (T + 1, N, 2), empty unless solved
    std::int64_t cost = 0, lower_bound = 0;
    std::size_t expansions = 0, generated = 0;
    double seconds = 0;
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
        const auto arrival = static_cast<int>(plan.actions(robot).size());
        makespan = std::max(makespan, arrival);
        outcome.cost += arrival;
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
        if (outcome.status == mapf::Status::solved) write_plan(grid.layout, starts, ecbs, outcome);
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
            outcome.generated, outcome.seconds};
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
                                               In<std::int64_t, 1> problem_of, In<std::int32_t, 3> positions, double w,
                                               std::size_t node_limit, std::uint64_t seed, int threads) {
    const std::size_t num_states = positions.shape(0), num_robots = positions.shape(1);
    auto [actions, actions_array] = mapf::make_array<std::int8_t>({num_states, num_robots});
    auto [solved, solved_array] = mapf::make_array<bool>({num_states});
    std::vector<mapf::GoalsOnGrid> goals;
    goals.reserve(problems.size());
    for (const auto& [grid, cells] : problems) {
        auto map = as_grid(grid);
        auto flat = as_cells(map.layout, cells);
        goals.push_back({std::move(map), std::move(flat)});
    }
    const mapf::States states{num_states, num_robots, positions.data(), problem_of.data()};
    run_without_gil([&, actions = actions, solved = solved](mapf::Interrupt& interrupt) {
        mapf::relabel(goals, states, {w, node_limit, seed}, threads, interrupt, actions, solved);
    });
    return {actions_array, solved_array};
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

ResultParts pibt(const GridArray& grids, const CellsArray& start_cells, const CellsArray& goal_cells, int max_steps,
                 std::uint64_t seed) {
    constexpr double no_limit = std::numeric_limits<double>::infinity();
    return run_one(grids, start_cells, goal_cells, no_limit, [&](const mapf::Grid& grid, const std::vector<int>& starts,
                                                                 const std::vector<int>& goals, mapf::Budget& budget,
                                                                 Outcome& outcome) {
        mapf::DistanceTables distances;
        if (!distances.compute(grid, goals, budget)) return;
        const mapf::Problem problem{grid, starts, goals, distances};
        const auto run = mapf::run_pibt(problem, max_steps, seed, budget);
        const auto num_robots = starts.size();
        const int steps = static_cast<int>(run.actions.size() / num_robots);
        outcome.expansions = outcome.generated = static_cast<std::size_t>(steps);
        outcome.lower_bound = sum_of_distances(problem);
        outcome.status = run.solved ? mapf::Status::solved : mapf::Status::step_limit;
        if (!run.solved) return;
        outcome.cost = std::accumulate(run.arrivals.begin(), run.arrivals.end(), std::int64_t{0});
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
                       if (outcome.status == mapf::Status::solved) write_plan(grid.layout, starts, planning, outcome);
                   });
}

// Improves the plan of `lacam` until it costs at most w times the lower bound or time is up.
void improve(const mapf::Grid& grid, const std::vector<int>& starts, const std::vector<int>& goals,
             const mapf::JointPlan& plan, double w, std::uint64_t seed, mapf::Budget& budget, Outcome& outcome) {
    write_plan(grid.layout, starts, plan, outcome);
    const auto target = mapf::cost_limit(w, outcome.lower_bound);
    mapf::DistanceTables distances;
    if (outcome.cost <= target || !distances.compute(grid, goals, budget)) return;
    const mapf::Problem problem{grid, starts, goals, distances};
    mapf::NeighbourhoodSearch neighbourhoods;
    neighbourhoods.begin(problem, seed, [&](std::size_t robot) { return plan.actions(robot); });
    neighbourhoods.run(target, std::numeric_limits<int>::max(), budget);
    if (neighbourhoods.cost() < outcome.cost) write_plan(grid.layout, starts, neighbourhoods, outcome);
}

ResultParts lacam(const GridArray& grids, const CellsArray& start_cells, const CellsArray& goal_cells, double w,
                  double time_limit, std::size_t node_limit, std::uint64_t seed) {
    return run_one(grids, start_cells, goal_cells, time_limit,
                   [&](const mapf::Grid& grid, const std::vector<int>& starts, const std::vector<int>& goals,
                       mapf::Budget& budget, Outcome& outcome) {
                       mapf::Lacam search(grid, starts, goals, seed);
                       outcome.status = search.run(node_limit, budget);
                       outcome.lower_bound = search.lower_bound();
                       outcome.expansions = search.expansions();
                       outcome.generated = search.generated();
                       if (outcome.status == mapf::Status::solved)
                           improve(grid, starts, goals, search.plan(), w, seed, budget, outcome);
                   });
}

}  // namespace

NB_MODULE(_native, m) {
    m.doc() = "Native solvers: arguments are checked in Python, statuses are the positions of the members of Status.";
    m.def("ecbs", &ecbs, "instances"_a, "w"_a, "time_limit"_a, "node_limit"_a, "seed"_a, "threads"_a,
          "Solves each instance (grid, starts, goals); see experts.solve_many.");
    m.def("relabel", &relabel, "problems"_a, "problem_of"_a, "positions"_a, "w"_a, "node_limit"_a, "seed"_a,
          "threads"_a, "First joint action for each state; see experts.relabel.");
    m.def("pibt", &pibt, "grid"_a, "starts"_a, "goals"_a, "max_steps"_a, "seed"_a,
          "Runs PIBT; see experts.pibt.");
    m.def("prioritised", &prioritised, "grid"_a, "starts"_a, "goals"_a, "max_orders"_a, "time_limit"_a, "seed"_a,
          "Prioritised planning; see experts.prioritised.");
    m.def("lacam", &lacam, "grid"_a, "starts"_a, "goals"_a, "w"_a, "time_limit"_a, "node_limit"_a, "seed"_a,
          "LaCAM; see experts.lacam.");
}
