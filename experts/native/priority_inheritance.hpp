// PIBT from the starts until all robots rest on their goals at once: a baseline that knows the whole map.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/problem.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

struct PibtRun {
    bool solved = false;
    std::vector<std::uint8_t> actions;  // (T, N): of every step taken
    std::vector<int> arrival_times;     // (N): since when each robot has been on its goal, if solved
};

// Each robot prefers the moves that bring it closer to its goal, ties in a random order drawn from `seed`. Robots that
// have been under way for longest come first. With `swap`, robots that face each other in a corridor change places.
PibtRun run_pibt(const Problem& problem, bool swap, int max_steps, std::uint64_t seed, Budget& budget);

}  // namespace mapf
