// Collision shielding by priority inheritance with backtracking: each robot gets the best action of its order of
// preference that the more important robots leave it, and those in its way are pushed aside.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <numeric>
#include <utility>
#include <vector>

#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/pibt_step.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

// The order of preference that a single wanted action stands for: it first, then idle, then the others by lot.
inline void prefer_action(int action, std::uint64_t key, std::uint8_t* preference) {
    std::array<std::uint8_t, num_actions> others{};
    int count = 0;
    for (int other = 0; other < idle; ++other)
        if (other != action) others[count++] = static_cast<std::uint8_t>(other);
    *preference++ = static_cast<std::uint8_t>(action);
    if (action != idle) *preference++ = idle;
    for (; count > 0; --count, key >>= 16) {
        const auto drawn = static_cast<int>((key & 0xffff) * static_cast<unsigned>(count) >> 16);
        *preference++ = others[drawn];
        others[drawn] = others[count - 1];
    }
}

// The actions by descending score, equal ones in the order up, left, down, right, idle.
inline void prefer_scores(const float* scores, std::uint8_t* preference) {
    std::iota(preference, preference + num_actions, std::uint8_t{0});
    for (int i = 1; i < num_actions; ++i)  // a stable insertion sort of five
        for (int j = i; j > 0 && scores[preference[j]] > scores[preference[j - 1]]; --j)
            std::swap(preference[j], preference[j - 1]);
}

// A robot's place in the order of a team, the least goes first: the longest under way, equal ones as `key` draws.
inline std::pair<std::uint64_t, int> pibt_rank(std::int32_t under_way, std::uint64_t key, int robot) {
    const auto waits = static_cast<std::uint32_t>(under_way);
    return {static_cast<std::uint64_t>(~waits) << 32 | mix(key, robot) >> 32, robot};
}

template <class T>
struct PibtScratch {
    PibtStep<T> step;
    std::vector<std::uint8_t> preferences;  // (N * 5)
    std::vector<int> cells, order;
    std::vector<std::pair<std::uint64_t, int>> rank;
    std::vector<std::uint8_t> actions;

    PibtScratch(const Layout& layout, int num_agents)
        : step(layout), preferences(num_agents * num_actions), cells(num_agents), order(num_agents), rank(num_agents),
          actions(num_agents) {}
};

// Executes the orders of preference in `scratch`, with swaps as PibtStep::decide takes them. Robots that have been under
// way (N) for longest come first, equal ones in the order that `key` draws. `blocked` is the map in its layout, border >= 1.
template <class T, class Swaps = NoSwaps>
void pibt_shield(const Layout& layout, const T* blocked, const std::int32_t* positions, const std::int32_t* under_way,
                 int num_agents, std::uint64_t key, PibtScratch<T>& scratch, std::int8_t* executed,
                 const Swaps& swaps = {}) {
    const std::size_t n = num_agents;
    for (int i = 0; i < num_agents; ++i) {
        scratch.cells[i] = layout.cell(positions[2 * i], positions[2 * i + 1]);
        scratch.rank[i] = pibt_rank(under_way[i], key, i);
    }
    std::sort(scratch.rank.begin(), scratch.rank.begin() + num_agents);
    for (int i = 0; i < num_agents; ++i) scratch.order[i] = scratch.rank[i].second;
    const std::span<std::uint8_t> actions(scratch.actions.data(), n);
    scratch.step.decide(blocked, {scratch.cells.data(), n}, {scratch.order.data(), n},
                        {scratch.preferences.data(), n * num_actions}, actions, swaps);
    for (std::size_t i = 0; i < n; ++i) executed[i] = static_cast<std::int8_t>(actions[i]);
}

}  // namespace mapf
