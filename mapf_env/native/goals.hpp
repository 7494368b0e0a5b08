// New goals for robots that have arrived, in lifelong tasks.
#pragma once

#include <cstdint>
#include <vector>

#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

// The random stream for the goal that a robot gets at its arrival number `arrival` of an episode.
inline Random goal_random(std::uint64_t seed, int robot, int arrival) {
    return Random(mix(mix(seed_for(Use::goals, seed), robot), arrival));
}

// A goal for a robot: uniform over the free cells that it can reach, except for all robots' goals and its own
// cell; if there is none, it keeps its goal. `regions` (layout.size()) numbers the connected regions, obstacles are -1;
// `taken` (layout.size()) has a 1 at each goal and is kept so. Returns whether the goal has changed.
inline bool draw_goal(const Layout& layout, const std::int32_t* regions, const std::int32_t* position, Random random,
                      std::uint8_t* taken, std::int32_t* goal) {
    constexpr int patience = 64;  // draws; where cells that fit are rarer than that, they are counted
    const int here = layout.cell(position[0], position[1]), area = layout.height * layout.width;
    const auto fits = [&](int place) {
        const int cell = layout.cell(place / layout.width, place % layout.width);
        return regions[cell] == regions[here] && !taken[cell] && cell != here;
    };
    int place = random.below(area);
    for (int draws = 1; draws < patience && !fits(place); ++draws) place = random.below(area);
    if (!fits(place)) {
        int count = 0;
        for (int each = 0; each < area; ++each) count += fits(each);
        if (count == 0) return false;
        int before = random.below(count);
        for (place = 0; !fits(place) || before > 0; ++place) before -= fits(place);
    }
    taken[layout.cell(goal[0], goal[1])] = 0;
    goal[0] = place / layout.width;
    goal[1] = place % layout.width;
    taken[layout.cell(goal[0], goal[1])] = 1;
    return true;
}

}  // namespace mapf
