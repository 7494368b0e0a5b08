// Makes the first plan of a crowd cheap.
#pragma once

#include <cstdint>

#include "experts/native/budget.hpp"
#include "experts/native/lazy_constraints.hpp"
#include "experts/native/neighbourhood_search.hpp"
#include "experts/native/problem.hpp"

namespace mapf {

// Shortens a plan of LaCAM that is long: plans again, by LaCAM, from random times of it to its end, and keeps what is not
// dearer. Ends when the plan costs at most `target` or is no longer long, or after a fixed number of expansions. In
// crowded mazes LaCAM's plans differ by factors, and are so long that replanning a few robots hardly shortens them.
void replan_tails(const Problem& problem, std::int64_t target, std::uint64_t seed, JointPlan& plan, Budget& budget);

// Improves LaCAM's plan until it costs at most `target`, `rounds` rounds of the neighbourhood search are over, or the
// budget is spent. Returns true if it has changed.
bool improve(const Problem& problem, std::int64_t target, int rounds, std::uint64_t seed, JointPlan& plan,
             NeighbourhoodSearch& neighbourhoods, Budget& budget);

}  // namespace mapf
