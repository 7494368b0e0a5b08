#include "experts/native/labels.hpp"

#include <algorithm>
#include <limits>

#include "experts/native/ecbs.hpp"
#include "experts/native/improvement.hpp"
#include "experts/native/lazy_constraints.hpp"
#include "experts/native/rolling_horizon.hpp"
#include "experts/native/work_queue.hpp"

namespace mapf {

namespace {

struct Workspace {
    DistanceTables distances;
    Ecbs ecbs;
    NeighbourhoodSearch neighbourhoods;
};

// Writes the first steps of a plan: plan.actions(robot) until it arrives.
template <class Plan>
void write(const Plan& plan, std::size_t robots, int steps, PlanLabels& labels) {
    for (std::size_t robot = 0; robot < robots; ++robot) {
        const auto arrival_time = static_cast<int>(plan.actions(robot).size());
        labels.makespan = std::max(labels.makespan, arrival_time);
        labels.cost += arrival_time;
    }
    labels.steps = std::min(steps, labels.makespan);
    labels.actions.assign(static_cast<std::size_t>(labels.steps) * robots, static_cast<std::uint8_t>(idle));
    for (std::size_t robot = 0; robot < robots; ++robot) {
        const auto actions = plan.actions(robot);
        for (std::size_t time = 0; time < actions.size() && time < static_cast<std::size_t>(labels.steps); ++time)
            labels.actions[time * robots + robot] = actions[time];
    }
}

// ECBS without its means for hard cases; what that leaves, LaCAM solves and the neighbourhood search improves.
void label(const Team& team, const LabelOptions& options, Workspace& workspace, Budget& budget, PlanLabels& labels) {
    const auto& [grid, starts, goals] = team;
    auto& [distances, ecbs, neighbourhoods] = workspace;
    if (!distances.compute(grid, goals, budget)) return;
    const Problem problem{grid, starts, goals, distances};
    const auto robots = starts.size();
    if (ecbs.solve(problem, {options.w, options.node_limit, options.seed, false}, budget) == Status::solved) {
        labels.found_by = ecbs.found_by();
        write(ecbs, robots, options.steps, labels);
        return;
    }
    Lacam lacam(grid, starts, goals, options.seed);
    if (lacam.run(Lacam::limits_of(options.node_limit), budget) != Status::solved) return;
    auto plan = lacam.plan();
    const bool improved =
        improve(problem, lacam.lower_bound(), options.rounds, options.seed, plan, neighbourhoods, budget);
    labels.found_by = improved ? FoundBy::improvement : FoundBy::lacam;
    write(plan, robots, options.steps, labels);
}

}  // namespace

std::vector<PlanLabels> label_plans(std::span<const Team> teams, const LabelOptions& options, int threads,
                                    Interrupt& interrupt) {
    std::vector<PlanLabels> labels(teams.size());
    run_jobs<Workspace>(teams.size(), threads, interrupt, [&](std::size_t job, Workspace& workspace, bool polls) {
        Budget budget(std::numeric_limits<double>::infinity(), interrupt, polls);
        label(teams[job], options, workspace, budget, labels[job]);
    });
    return labels;
}

std::vector<std::vector<std::uint8_t>> next_moves(std::span<const Team> teams, int window, int rounds,
                                                  std::uint64_t seed, int threads, Interrupt& interrupt) {
    struct Nothing {};
    std::vector<std::vector<std::uint8_t>> moves(teams.size());
    run_jobs<Nothing>(teams.size(), threads, interrupt, [&](std::size_t job, Nothing&, bool polls) {
        const auto& [grid, starts, goals] = teams[job];
        Budget budget(std::numeric_limits<double>::infinity(), interrupt, polls);
        RollingHorizon planner(grid, window, rounds, seed);
        planner.plan(starts, goals, 0, budget);
        for (std::size_t robot = 0; robot < starts.size(); ++robot)
            moves[job].push_back(static_cast<std::uint8_t>(planner.action(robot, 0)));
    });
    return moves;
}

}  // namespace mapf
