// Large neighbourhood search: mends a joint plan, then shortens it, a few robots at a time.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/problem.hpp"
#include "experts/native/reservations.hpp"
#include "experts/native/safe_interval_search.hpp"
#include "mapf_env/native/random.hpp"

namespace mapf {

// Li, Chen, Harabor, Stuckey and Koenig: "Anytime multi-agent path finding via large neighborhood search" (IJCAI 2021)
// and "MAPF-LNS2: fast repairing for multi-agent path finding via large neighborhood search" (AAAI 2022). It proves
// nothing; who knows a lower bound can tell what its plans are worth.
class NeighbourhoodSearch {
public:
    // Begins with the given plan, which may have conflicts: path_of(robot) is a span of actions. The problem must live
    // as long as the search goes on.
    template <class PathOf>
    void begin(const Problem&&, std::uint64_t, const PathOf&) = delete;
    template <class PathOf>
    void begin(const Problem& problem, std::uint64_t seed, const PathOf& path_of) {
        reset(problem, seed);
        for (std::size_t robot = 0; robot < plan_.size(); ++robot) {
            const auto actions = path_of(robot);
            plan_[robot].assign(actions.begin(), actions.end());
            insert(static_cast<int>(robot));
        }
    }

    // Replans neighbourhoods until no robots meet and the cost is at most `target`, or `rounds` rounds are over.
    bool run(std::int64_t target, int rounds, Budget& budget);

    bool feasible() const { return meeting_pairs_ == 0; }
    std::int64_t cost() const { return cost_; }
    std::span<const std::uint8_t> actions(std::size_t robot) const { return plan_[robot]; }

private:
    void reset(const Problem& problem, std::uint64_t seed);
    void adapt(bool progress);
    void choose_meeting_robots();
    void choose_delayed_robot_and_blockers();
    bool choose(int robot);
    void wander(int robot, int time);
    void replan(Budget& budget);
    bool plan(int robot, int tolerance, int latest, Budget& budget);
    int distance(int robot) const { return problem_->distances.to_goal_of(robot)[problem_->starts[robot]]; }
    void insert(int robot);
    void take_out(int robot);
    int arrival_time(int robot) const { return static_cast<int>(plan_[robot].size()); }
    int delay(int robot) const { return arrival_time(robot) - distance(robot); }
    PathView view(int robot) const;

    const Problem* problem_ = nullptr;  // during a search
    Random random_{0};
    Reservations reservations_;
    SafeIntervalSearch search_;
    std::vector<std::vector<std::uint8_t>> plan_, old_plan_;
    std::vector<std::vector<int>> partners_;  // whom each robot meets
    std::vector<int> chosen_;                 // the neighbourhood
    std::vector<std::uint8_t> is_chosen_;
    std::vector<int> cells_;
    std::int64_t cost_ = 0;
    int meeting_pairs_ = 0;
    std::size_t size_ = 0;  // of a neighbourhood
    int futile_ = 0;        // rounds since the last progress
};

}  // namespace mapf
