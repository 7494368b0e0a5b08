#include "experts/native/neighbourhood_search.hpp"

#include <algorithm>

namespace mapf {

namespace {

constexpr std::size_t first_neighbourhood = 3, largest_neighbourhood = 12;
constexpr int patience = 16;  // rounds without progress before neighbourhoods grow

}  // namespace

void NeighbourhoodSearch::reset(const Problem& problem, std::uint64_t seed) {
    problem_ = &problem;
    random_ = Random(seed);
    const auto robots = problem.starts.size();
    reservations_.reset(problem.grid.layout);
    plan_.resize(robots);
    old_plan_.resize(robots);
    partners_.assign(robots, {});
    is_chosen_.assign(robots, 0);
    chosen_.clear();
    cost_ = 0;
    meeting_pairs_ = 0;
    size_ = first_neighbourhood;
    futile_ = 0;
}

bool NeighbourhoodSearch::run(std::int64_t target, int rounds, Budget& budget) {
    for (int round = 0; !feasible() || cost_ > target; ++round) {
        if (round >= rounds || budget.look()) return false;
        for (const int robot : chosen_) is_chosen_[robot] = 0;
        chosen_.clear();
        if (feasible())
            choose_delayed_robot_and_blockers();
        else
            choose_meeting_robots();
        if (chosen_.empty()) return false;
        const int pairs = meeting_pairs_;
        const auto cost = cost_;
        replan(budget);
        adapt(meeting_pairs_ < pairs || (feasible() && cost_ < cost));
    }
    return true;
}

// Neighbourhoods are small as long as that helps.
void NeighbourhoodSearch::adapt(bool progress) {
    if (progress) {
        futile_ = 0;
        size_ = first_neighbourhood;
    } else if (++futile_ % patience == 0) {
        size_ = size_ == largest_neighbourhood ? first_neighbourhood : size_ + 1;
    }
}

// A robot that meets others, these, and whom they find around them.
void NeighbourhoodSearch::choose_meeting_robots() {
    const int robots = static_cast<int>(plan_.size());
    int first = random_.below(robots);
    while (partners_[first].empty()) first = (first + 1) % robots;
    choose(first);
    auto partners = partners_[first];
    random_.shuffle_front(partners, static_cast<int>(partners.size()));
    for (const int partner : partners) choose(partner);
    for (std::size_t i = 0; i < chosen_.size() && chosen_.size() < size_; ++i)
        wander(chosen_[i], random_.below(arrival_time(chosen_[i]) + 1));
}

// One of the most delayed of a few robots, and whom it meets where it would gain time.
void NeighbourhoodSearch::choose_delayed_robot_and_blockers() {
    const int robots = static_cast<int>(plan_.size());
    int first = -1;
    for (int draw = 0; draw < 4; ++draw) {
        int robot = random_.below(robots);
        for (int i = 0; i < robots && delay(robot) == 0; ++i) robot = (robot + 1) % robots;
        if (first < 0 || delay(robot) > delay(first)) first = robot;
    }
    if (delay(first) == 0) return;
    choose(first);
    for (int walk = 0; walk < 10 && chosen_.size() < size_; ++walk)
        wander(chosen_[random_.below(static_cast<int>(chosen_.size()))], random_.below(arrival_time(first)));
}

bool NeighbourhoodSearch::choose(int robot) {
    if (is_chosen_[robot] || chosen_.size() >= size_) return false;
    is_chosen_[robot] = 1;
    chosen_.push_back(robot);
    return true;
}

// Walks at random from where the robot is at `time`, as long as it could still arrive earlier than it does, and
// chooses the robots in the way.
void NeighbourhoodSearch::wander(int robot, int time) {
    const auto steps = problem_->grid.layout.steps();
    const auto* distance = problem_->distances.to_goal_of(robot);
    const int latest = feasible() ? arrival_time(robot) - 1 : arrival_time(robot) + 2;
    time = std::min(time, arrival_time(robot));
    int cell = problem_->starts[robot];
    for (int step = 0; step < time; ++step) cell += steps[plan_[robot][step]];
    for (; time < latest && chosen_.size() < size_; ++time) {
        int way = -1, ways = 0;
        for (int action = 0; action < num_actions; ++action) {
            const int next = cell + steps[action];
            if (distance[next] == unreachable || time + 1 + distance[next] > latest) continue;
            if (random_.below(++ways) == 0) way = action;
        }
        if (way < 0) return;
        const int next = cell + steps[way];
        reservations_.visitors(next, time + 1, [&](int other) { choose(other); });
        if (const auto rest = reservations_.rest(next); rest.time <= time) choose(rest.robot);
        if (const int other = reservations_.opposing(cell, next, time + 1); other >= 0) choose(other);
        cell = next;
    }
}

// Plans the chosen robots one after the other in a random order, and keeps the result where it is no worse.
void NeighbourhoodSearch::replan(Budget& budget) {
    const bool mending = !feasible();
    const int pairs_before = meeting_pairs_;
    const auto cost_before = cost_;
    random_.shuffle_front(chosen_, static_cast<int>(chosen_.size()));
    for (const int robot : chosen_) {
        take_out(robot);
        old_plan_[robot] = plan_[robot];
    }
    std::int64_t least = cost_;  // what the result costs at least, while the rest of the robots take the shortest ways
    for (const int robot : chosen_) least += distance(robot);
    std::size_t planned = 0;
    for (; planned < chosen_.size(); ++planned) {
        const int robot = chosen_[planned];
        least -= distance(robot);
        const auto latest = mending ? forever : static_cast<int>(std::min<std::int64_t>(cost_before - least, forever));
        if (!plan(robot, mending ? forever : 0, latest, budget)) break;
        least += arrival_time(robot);
        insert(chosen_[planned]);
        if (mending ? meeting_pairs_ > pairs_before : cost_ > cost_before) {
            ++planned;
            break;
        }
    }
    const bool better = mending ? meeting_pairs_ <= pairs_before : cost_ <= cost_before;
    if (planned == chosen_.size() && better) return;
    for (std::size_t i = 0; i < planned; ++i) take_out(chosen_[i]);
    for (const int robot : chosen_) {
        plan_[robot] = old_plan_[robot];
        insert(robot);
    }
}

bool NeighbourhoodSearch::plan(int robot, int tolerance, int latest, Budget& budget) {
    if (!search_.run(problem_->grid, reservations_, problem_->starts[robot], problem_->goals[robot],
                     problem_->distances.to_goal_of(robot), tolerance, latest, budget))
        return false;
    plan_[robot] = search_.actions();
    return true;
}

void NeighbourhoodSearch::insert(int robot) {
    auto& partners = partners_[robot];
    reservations_.meetings(robot, view(robot), [&](int other) {
        if (std::find(partners.begin(), partners.end(), other) != partners.end()) return;
        partners.push_back(other);
        partners_[other].push_back(robot);
        ++meeting_pairs_;
    });
    reservations_.add(robot, view(robot));
    cost_ += arrival_time(robot);
}

void NeighbourhoodSearch::take_out(int robot) {
    for (const int other : partners_[robot]) {
        auto& theirs = partners_[other];
        theirs.erase(std::find(theirs.begin(), theirs.end(), robot));
        --meeting_pairs_;
    }
    partners_[robot].clear();
    reservations_.remove(robot, view(robot));
    cost_ -= arrival_time(robot);
}

PathView NeighbourhoodSearch::view(int robot) const { return {problem_->starts[robot], plan_[robot]}; }

}  // namespace mapf
