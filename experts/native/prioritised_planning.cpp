#include "experts/native/prioritised_planning.hpp"

#include <algorithm>
#include <numeric>

#include "mapf_env/native/random.hpp"

namespace mapf {

Status PrioritisedPlanning::run(const Problem& problem, int max_orders, std::uint64_t seed, Budget& budget) {
    const auto robots = problem.starts.size();
    const auto distance = [&](int robot) {
        return problem.distances.to_goal_of(static_cast<std::size_t>(robot))[problem.starts[robot]];
    };
    plan_.resize(robots);
    std::vector<int> order(robots);
    std::iota(order.begin(), order.end(), 0);
    Random(seed).shuffle_front(order, static_cast<int>(robots));
    std::ranges::stable_sort(order, std::ranges::greater{}, distance);
    for (orders_ = 1; orders_ <= static_cast<std::size_t>(max_orders); ++orders_) {
        reservations_.reset(problem.grid.layout);
        const auto stuck = std::ranges::find_if(order, [&](int robot) {
            const int start = problem.starts[robot];
            if (!search_.run(problem.grid, reservations_, start, problem.goals[robot],
                             problem.distances.to_goal_of(static_cast<std::size_t>(robot)), 0, forever, budget))
                return true;
            plan_[robot] = search_.actions();
            reservations_.add(robot, {start, plan_[robot]});
            return false;
        });
        if (stuck == order.end()) return Status::solved;
        if (budget.look()) return Status::time_limit;
        std::rotate(order.begin(), stuck, stuck + 1);
    }
    --orders_;
    return Status::node_limit;
}

}  // namespace mapf
