// Labels by plan: many states are solved once each, and the first steps of a plan label the states on it. In lifelong
// tasks goals change where robots arrive, so there only a state itself is labelled.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/problem.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// A team on a map: where its robots are and where they have to go.
struct Team {
    Grid grid;
    std::vector<int> starts, goals;
};

struct LabelOptions {
    int steps;               // labelled steps of a plan
    double w;                // the factor of ECBS, which is asked first
    std::size_t node_limit;  // of each search for a plan
    int rounds;              // of the neighbourhood search on a plan of LaCAM
    std::uint64_t seed;
};

// The plan of a team: its first joint actions (steps, N), empty if there is no plan.
struct PlanLabels {
    FoundBy found_by = FoundBy::none;
    std::int64_t cost = 0;
    int makespan = 0;
    int steps = 0;  // at most as many as asked for and as the plan has
    std::vector<std::uint8_t> actions;
};

// One result for each team. No clock decides, so results depend on the arguments only. Throws std::invalid_argument if a
// path is too long to be counted.
std::vector<PlanLabels> label_plans(std::span<const Team> teams, const LabelOptions& options, int threads,
                                    Interrupt& interrupt);

// The first joint action (N) of each team's plan by a new planner with a rolling horizon.
std::vector<std::vector<std::uint8_t>> next_moves(std::span<const Team> teams, int window, int rounds,
                                                  std::uint64_t seed, int threads, Interrupt& interrupt);

}  // namespace mapf
