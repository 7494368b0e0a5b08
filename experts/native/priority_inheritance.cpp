#include "experts/native/priority_inheritance.hpp"

#include <algorithm>
#include <array>
#include <numeric>

#include "mapf_env/native/pibt_step.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

namespace {

// All five actions, the closest to the goal first.
void prefer_short_ways(const Grid& grid, const Distance* distance, int cell, Random& random, std::uint8_t* preference) {
    const std::span<std::uint8_t> actions(preference, num_actions);
    std::iota(actions.begin(), actions.end(), std::uint8_t{0});
    for (int i = 0; i < num_actions; ++i) std::swap(actions[i], actions[i + random.below(num_actions - i)]);
    const auto steps = grid.layout.steps();
    std::array<Distance, num_actions> after{};
    for (int action = 0; action < num_actions; ++action) after[action] = distance[cell + steps[action]];
    for (int i = 1; i < num_actions; ++i)  // a stable insertion sort of five
        for (int j = i; j > 0 && after[actions[j]] < after[actions[j - 1]]; --j) std::swap(actions[j], actions[j - 1]);
}

}  // namespace

PibtRun run_pibt(const Problem& problem, bool swap, int max_steps, std::uint64_t seed, Budget& budget) {
    const std::size_t num_robots = problem.starts.size();
    const auto steps = problem.grid.layout.steps();
    Random random(seed);
    PibtStep<> step(problem.grid.layout);
    const TableSwaps swaps{problem.goals, [&](int robot) { return problem.distances.to_goal_of(robot); }};
    PibtRun run{false, {}, std::vector<int>(num_robots, 0)};
    std::vector<int> cells(problem.starts.begin(), problem.starts.end()), order(num_robots), under_way(num_robots, 0);
    std::vector<std::uint8_t> preferences(num_robots * num_actions), actions(num_robots);
    std::iota(order.begin(), order.end(), 0);
    random.shuffle_front(order, static_cast<int>(num_robots));
    for (int time = 0;; ++time) {
        run.solved = true;
        for (std::size_t robot = 0; robot < num_robots; ++robot) {
            if (cells[robot] == problem.goals[robot]) continue;
            run.solved = false;
            run.arrival_times[robot] = time + 1;
        }
        if (run.solved || time == max_steps || budget.look()) return run;
        std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return under_way[a] > under_way[b]; });
        for (std::size_t robot = 0; robot < num_robots; ++robot)
            prefer_short_ways(problem.grid, problem.distances.to_goal_of(robot), cells[robot], random,
                              &preferences[robot * num_actions]);
        if (swap)
            step.decide(problem.grid.blocked.data(), cells, order, preferences, actions, swaps);
        else
            step.decide(problem.grid.blocked.data(), cells, order, preferences, actions);
        for (std::size_t robot = 0; robot < num_robots; ++robot) {
            cells[robot] += steps[actions[robot]];
            under_way[robot] = cells[robot] == problem.goals[robot] ? 0 : under_way[robot] + 1;
        }
        run.actions.insert(run.actions.end(), actions.begin(), actions.end());
    }
}

}  // namespace mapf
