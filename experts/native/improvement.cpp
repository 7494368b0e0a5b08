#include "experts/native/improvement.hpp"

#include <algorithm>
#include <utility>
#include <vector>

#include "mapf_env/native/random.hpp"

namespace mapf {

namespace {

constexpr std::int64_t long_plan = 4;            // times the sum of the distances
constexpr std::size_t tail_expansions = 50'000;  // of all tails
constexpr std::size_t slack = 20;                // expansions of a tail beyond twice its length

std::int64_t sum_of_distances(const Problem& problem) {
    std::int64_t sum = 0;
    for (std::size_t robot = 0; robot < problem.starts.size(); ++robot)
        sum += problem.distances.to_goal_of(robot)[problem.starts[robot]];
    return sum;
}

// The first `time` steps of `plan`, then all of `tail`.
JointPlan joined(const JointPlan& plan, std::size_t time, const JointPlan& tail) {
    JointPlan whole = plan;
    for (std::size_t robot = 0; robot < whole.of_robot.size(); ++robot) {
        auto& actions = whole.of_robot[robot];
        actions.resize(time, static_cast<std::uint8_t>(idle));
        actions.insert(actions.end(), tail.of_robot[robot].begin(), tail.of_robot[robot].end());
        while (!actions.empty() && actions.back() == idle) actions.pop_back();
    }
    return whole;
}

}  // namespace

void replan_tails(const Problem& problem, std::int64_t target, std::uint64_t seed, JointPlan& plan, Budget& budget) {
    const auto& [grid, starts, goals, distances] = problem;
    const auto steps = grid.layout.steps();
    const auto short_enough = std::max(target, long_plan * sum_of_distances(problem));
    Random random(seed);
    auto cost = plan.cost();
    auto expansions = tail_expansions;
    std::vector<int> cells;
    for (std::uint64_t tail = 1; cost > short_enough && plan.makespan() > 1 && !budget.look(); ++tail) {
        const auto time = static_cast<std::size_t>(random.below(static_cast<int>(plan.makespan())));
        cells.assign(starts.begin(), starts.end());
        for (std::size_t robot = 0; robot < cells.size(); ++robot)
            for (const int action : plan.actions(robot).first(std::min(time, plan.actions(robot).size())))
                cells[robot] += steps[action];
        const auto patience = std::min(expansions, 2 * (plan.makespan() - time) + slack);
        Lacam lacam(grid, cells, goals, mix(seed, tail));
        const bool found = lacam.run({patience, patience}, budget) == Status::solved;
        expansions -= std::min(expansions, std::max<std::size_t>(lacam.expansions(), 1));
        if (expansions == 0) return;
        if (!found) continue;
        auto candidate = joined(plan, time, lacam.plan());
        if (candidate.cost() > cost) continue;
        cost = candidate.cost();
        plan = std::move(candidate);
    }
}

bool improve(const Problem& problem, std::int64_t target, int rounds, std::uint64_t seed, JointPlan& plan,
             NeighbourhoodSearch& neighbourhoods, Budget& budget) {
    const auto first = plan.cost();
    replan_tails(problem, target, seed, plan, budget);
    neighbourhoods.begin(problem, seed, [&](std::size_t robot) { return plan.actions(robot); });
    neighbourhoods.run(target, rounds, budget);
    for (std::size_t robot = 0; robot < plan.of_robot.size(); ++robot) {
        const auto actions = neighbourhoods.actions(robot);
        plan.of_robot[robot].assign(actions.begin(), actions.end());
    }
    return plan.cost() < first;
}

}  // namespace mapf
