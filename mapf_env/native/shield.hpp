// Collision shielding as the paper describes it: an action that would hit something becomes idle.
#pragma once

#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

// Scratch of the shield for maps of one size; reused over teams and steps.
struct ShieldScratch {
    std::vector<int> occupant;  // robot standing on each cell, num_agents for none
    std::vector<int> claimant;  // robot that will be in each cell, -1 for none
    std::vector<int> cell, aim, target, contested;

    ShieldScratch(const Layout& layout, int num_agents)
        : occupant(layout.size(), num_agents), claimant(layout.size(), -1), cell(num_agents + 1), aim(num_agents + 1),
          target(num_agents), contested(num_agents), nobody_(num_agents) {
        cell[nobody_] = aim[nobody_] = -1;
    }

    int nobody() const { return nobody_; }

private:
    int nobody_;
};

// Brings the paper's shield to its fixed point: moves off the map, into obstacles and swaps become idle; of several
// robots that enter a cell one goes, drawn by `key`; nobody enters the cell of a robot that stays. What remains never
// collides, and a joint action without conflicts passes unchanged. `blocked` is the map in its layout, border >= 1.
template <class T>
void shield(const Layout& layout, const T* blocked, const std::int32_t* positions, const std::int64_t* actions,
            int num_agents, std::uint64_t key, ShieldScratch& scratch, std::int8_t* executed) {
    const auto steps = layout.steps();
    int *const occupant = scratch.occupant.data(), *const claimant = scratch.claimant.data();
    int *const cell = scratch.cell.data(), *const aim = scratch.aim.data(), *const target = scratch.target.data();
    for (int i = 0; i < num_agents; ++i) {
        cell[i] = layout.cell(positions[2 * i], positions[2 * i + 1]);
        aim[i] = cell[i] + steps[actions[i]];
        occupant[cell[i]] = i;
    }
    // Random actions cannot be predicted: these loops have no branches, and what needs some is put aside.
    for (int i = 0; i < num_agents; ++i) {
        const bool swaps = (aim[occupant[aim[i]]] == cell[i]) & (aim[i] != cell[i]);
        const bool stays = swaps | (blocked[aim[i]] != T{0});
        target[i] = stays ? cell[i] : aim[i];
        executed[i] = static_cast<std::int8_t>(stays ? idle : actions[i]);
    }
    int num_contested = 0;
    for (int i = 0; i < num_agents; ++i) {
        int& holder = claimant[target[i]];
        const bool is_free = holder < 0;
        holder = is_free ? i : holder;
        scratch.contested[num_contested] = i;
        num_contested += !is_free;
    }
    // Robot i stays; so does who would enter its cell, and so on: everyone takes his own cell and pushes out another.
    const auto stop = [&](int i) {
        while (i >= 0) {
            executed[i] = idle;
            target[i] = cell[i];
            const int follower = claimant[cell[i]];
            claimant[cell[i]] = i;
            i = follower;
        }
    };
    for (int k = 0; k < num_contested; ++k) {
        const int i = scratch.contested[k], there = target[i], holder = claimant[there];
        if (holder == i) continue;  // stopped in the meantime
        const bool wins = there == cell[i] || (target[holder] != cell[holder] && mix(key, i) < mix(key, holder));
        if (wins) claimant[there] = i;
        stop(wins ? holder : i);
    }
    for (int i = 0; i < num_agents; ++i) {
        occupant[cell[i]] = scratch.nobody();
        claimant[cell[i]] = claimant[aim[i]] = -1;
    }
}

}  // namespace mapf
