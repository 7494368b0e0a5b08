// The input of every solver, and the possible ends of a search.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// In the order of Python's Status.
enum class Status : std::uint8_t { solved, node_limit, time_limit, infeasible, step_limit };

// The part of a solver that found its plan, in the order of Python's FoundBy.
enum class FoundBy : std::uint8_t { none, ecbs, repair, proof, lacam, improvement, prioritised, pibt };

// The highest cost within the factor w, possibly infinite, of a bound.
inline std::int64_t cost_limit(double w, std::int64_t bound) {
    constexpr auto most = std::int64_t{1} << 62;
    const double limit = std::floor(w * static_cast<double>(bound));
    return limit < static_cast<double>(most) ? static_cast<std::int64_t>(limit) : most;  // most for inf * 0 too
}

// Steps to each robot's goal from every cell.
class DistanceTables {
public:
    // Returns false if the budget was spent first.
    bool compute(const Grid& grid, std::span<const int> goals, Budget& budget) {
        if (tables_.size() < goals.size()) tables_.resize(goals.size());
        for (std::size_t robot = 0; robot < goals.size(); ++robot) {
            distances_to(grid, goals[robot], tables_[robot], queue_);
            if (budget.look()) return false;
        }
        return true;
    }

    const Distance* to_goal_of(std::size_t robot) const { return tables_[robot].data(); }

private:
    std::vector<std::vector<Distance>> tables_;
    std::vector<int> queue_;
};

// Starts, goals and distances of N robots; cells are those of grid.layout.
struct Problem {
    const Grid& grid;
    std::span<const int> starts, goals;
    const DistanceTables& distances;
};

}  // namespace mapf
