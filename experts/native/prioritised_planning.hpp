// Prioritised planning: one robot after the other, around those before it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/problem.hpp"
#include "experts/native/reservations.hpp"
#include "experts/native/safe_interval_search.hpp"

namespace mapf {

// Erdmann and Lozano-Perez 1987, "On multiple moving objects", with each robot's path the shortest that is left. The
// robots with the longest way come first; whoever finds no path comes first in the next order.
class PrioritisedPlanning {
public:
    Status run(const Problem& problem, int max_orders, std::uint64_t seed, Budget& budget);

    std::span<const std::uint8_t> actions(std::size_t robot) const { return plan_[robot]; }
    std::size_t orders() const { return orders_; }  // that were tried

private:
    Reservations reservations_;
    SafeIntervalSearch search_;
    std::vector<std::vector<std::uint8_t>> plan_;
    std::size_t orders_ = 0;
};

}  // namespace mapf
