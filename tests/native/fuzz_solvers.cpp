// Runs all native solvers on random small crowds, to be built with sanitizers: see sanitize.sh.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "experts/native/ecbs.hpp"
#include "experts/native/labels.hpp"
#include "experts/native/lazy_constraints.hpp"
#include "experts/native/priority_inheritance.hpp"
#include "experts/native/prioritised_planning.hpp"
#include "experts/native/rolling_horizon.hpp"
#include "mapf_env/native/random.hpp"

namespace {

struct Crowd {
    mapf::Grid grid;
    std::vector<int> starts, goals;
};

// Robots in one region of a random map, so that every goal can be reached.
Crowd draw(mapf::Random& random) {
    const int height = 1 + random.below(9), width = 2 + random.below(9), blocked = random.below(4);
    std::vector<std::uint8_t> obstacles(static_cast<std::size_t>(height * width));
    for (auto& obstacle : obstacles) obstacle = random.below(10) < blocked;
    obstacles[0] = 0;
    mapf::Grid grid(obstacles.data(), height, width);
    const auto regions = mapf::regions_of(grid);
    std::vector<int> free;
    for (int row = 0; row < height; ++row)
        for (int col = 0; col < width; ++col)
            if (regions[grid.layout.cell(row, col)] == 0) free.push_back(grid.layout.cell(row, col));
    const int robots = 1 + random.below(std::min<int>(12, static_cast<int>(free.size())));
    random.shuffle_front(free, robots);
    std::vector<int> starts(free.begin(), free.begin() + robots);
    random.shuffle_front(free, robots);
    return {std::move(grid), std::move(starts), {free.begin(), free.begin() + robots}};
}

template <class Plan>
void require(bool condition, const char* what, const Plan& crowd) {
    if (condition) return;
    std::fprintf(stderr, "%s, on a map of %d x %d\n", what, crowd.grid.layout.height, crowd.grid.layout.width);
    std::abort();
}

// Returns true if all robots reach their goals without a conflict.
template <class ActionsOf>
bool is_plan(const Crowd& crowd, const ActionsOf& actions_of) {
    auto cells = crowd.starts;
    const auto steps = crowd.grid.layout.steps();
    std::size_t makespan = 0;
    for (std::size_t robot = 0; robot < cells.size(); ++robot) makespan = std::max(makespan, actions_of(robot).size());
    for (std::size_t time = 0; time < makespan; ++time) {
        const auto before = cells;
        for (std::size_t robot = 0; robot < cells.size(); ++robot) {
            if (time < actions_of(robot).size()) cells[robot] += steps[actions_of(robot)[time]];
            if (crowd.grid.blocked[cells[robot]]) return false;
        }
        for (std::size_t i = 0; i < cells.size(); ++i)
            for (std::size_t j = 0; j < i; ++j)
                if (cells[i] == cells[j] || (cells[i] == before[j] && cells[j] == before[i])) return false;
    }
    return cells == crowd.goals;
}

// True if no joint move of the first steps leaves the map or has a conflict.
template <class ActionOf>
bool is_legal(const Crowd& crowd, const ActionOf& action_of, std::size_t num_steps) {
    auto cells = crowd.starts;
    const auto steps = crowd.grid.layout.steps();
    for (std::size_t time = 0; time < num_steps; ++time) {
        const auto before = cells;
        for (std::size_t robot = 0; robot < cells.size(); ++robot) {
            cells[robot] += steps[action_of(time, robot)];
            if (crowd.grid.blocked[cells[robot]]) return false;
        }
        for (std::size_t i = 0; i < cells.size(); ++i)
            for (std::size_t j = 0; j < i; ++j)
                if (cells[i] == cells[j] || (cells[i] == before[j] && cells[j] == before[i])) return false;
    }
    return true;
}

// Robots that arrive turn round; every window has to be legal.
void play_with_rolling_horizon(Crowd crowd, std::uint64_t seed, mapf::Budget& budget) {
    const int window = 1 + static_cast<int>(seed % 9);
    const int executed = 1 + static_cast<int>(seed % static_cast<std::uint64_t>(window));
    mapf::RollingHorizon planner(crowd.grid, window, 10, seed);
    auto homes = crowd.starts;
    for (int turn = 0; turn < 4; ++turn) {
        planner.plan(crowd.starts, crowd.goals, turn == 0 ? 0 : executed, budget);
        const auto action_of = [&](std::size_t time, std::size_t robot) {
            return planner.action(robot, static_cast<int>(time));
        };
        require(is_legal(crowd, action_of, static_cast<std::size_t>(window)), "a window has a conflict", crowd);
        for (int time = 0; time < executed; ++time)
            for (std::size_t robot = 0; robot < homes.size(); ++robot)
                crowd.starts[robot] += crowd.grid.layout.steps()[planner.action(robot, time)];
        for (std::size_t robot = 0; robot < homes.size(); ++robot)
            if (crowd.starts[robot] == crowd.goals[robot]) std::swap(crowd.goals[robot], homes[robot]);
    }
}

}  // namespace

int main(int count, char** arguments) {
    const int rounds = count > 1 ? std::atoi(arguments[1]) : 300;
    mapf::Random random(count > 2 ? static_cast<std::uint64_t>(std::atoll(arguments[2])) : 0);
    mapf::Ecbs ecbs;
    mapf::PrioritisedPlanning planning;
    mapf::DistanceTables distances;
    std::vector<mapf::Team> teams;
    int solved = 0;
    for (int round = 0; round < rounds; ++round) {
        const auto crowd = draw(random);
        const auto& [grid, starts, goals] = crowd;
        mapf::Interrupt interrupt([] { return false; });
        mapf::Budget budget(std::numeric_limits<double>::infinity(), interrupt, true);
        distances.compute(grid, goals, budget);
        const mapf::Problem problem{grid, starts, goals, distances};
        const auto seed = static_cast<std::uint64_t>(round);
        for (const double w : {1.0, 1.05, 1.3}) {
            const bool proved = ecbs.solve(problem, {w, 300, seed}, budget) == mapf::Status::solved;
            require(ecbs.has_plan() || !proved, "ECBS has solved a crowd without a plan", crowd);
            if (!ecbs.has_plan()) continue;
            ++solved;
            require(is_plan(crowd, [&](std::size_t robot) { return ecbs.actions(robot); }), "no plan by ECBS", crowd);
            require((ecbs.cost() <= w * ecbs.lower_bound()) == proved, "the bound of ECBS does not hold", crowd);
        }
        mapf::Lacam lacam(grid, starts, goals, seed);
        if (lacam.run(mapf::Lacam::limits_of(300), budget) == mapf::Status::solved) {
            const auto plan = lacam.plan();
            require(is_plan(crowd, [&](std::size_t robot) { return plan.actions(robot); }), "no plan by LaCAM", crowd);
        }
        if (planning.run(problem, 5, seed, budget) == mapf::Status::solved)
            require(is_plan(crowd, [&](std::size_t robot) { return planning.actions(robot); }), "no plan", crowd);
        const auto run = mapf::run_pibt(problem, round % 2 == 0, 50, seed, budget);
        require(is_legal(crowd, [&](std::size_t time, std::size_t robot) { return run.actions[time * starts.size() + robot]; },
                         run.actions.size() / starts.size()),
                "PIBT makes an illegal move", crowd);
        play_with_rolling_horizon(crowd, seed, budget);
        teams.push_back({grid, starts, goals});
    }
    mapf::Interrupt interrupt([] { return false; });
    const auto labels = mapf::label_plans(teams, {20, 1.2, 300, 20, 0}, 2, interrupt);
    for (std::size_t i = 0; i < teams.size(); ++i) {
        const Crowd crowd{teams[i].grid, teams[i].starts, teams[i].goals};
        const auto action_of = [&](std::size_t time, std::size_t robot) {
            return labels[i].actions[time * crowd.starts.size() + robot];
        };
        require(is_legal(crowd, action_of, static_cast<std::size_t>(labels[i].steps)), "labels conflict", crowd);
    }
    std::printf("%d crowds, %d plans by ECBS\n", rounds, solved);
}
