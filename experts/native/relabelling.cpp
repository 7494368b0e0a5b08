#include "experts/native/relabelling.hpp"

#include <algorithm>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <string>

#include "experts/native/work_queue.hpp"

namespace mapf {

namespace {

constexpr std::size_t states_in_a_job = 64;

// States order[begin..end), all of one problem.
struct Job {
    std::size_t begin, end;
};

std::vector<Job> cut_into_jobs(const States& states, const std::vector<std::size_t>& order) {
    std::vector<Job> jobs;
    for (std::size_t i = 0; i < order.size(); ++i) {
        const bool same = i > 0 && states.problem_of[order[i]] == states.problem_of[order[i - 1]];
        if (!same || i - jobs.back().begin == states_in_a_job) jobs.push_back({i, i});
        jobs.back().end = i + 1;
    }
    return jobs;
}

struct Workspace {
    DistanceTables distances;
    std::int64_t problem = -1;  // of the distances
    Ecbs ecbs;
    std::vector<int> cells;
    std::vector<std::size_t> seen_in;  // for each cell, 1 + the last state with a robot there
};

[[noreturn]] void reject(std::size_t state, std::size_t robot, int row, int col, const std::string& what) {
    throw std::invalid_argument("positions[" + std::to_string(state) + ", " + std::to_string(robot) + "]: agent " +
                                std::to_string(robot) + " at (" + std::to_string(row) + ", " + std::to_string(col) +
                                ") " + what);
}

// Reads state `state` into workspace.cells.
void read_state(const States& states, std::size_t state, const Grid& grid, Workspace& workspace) {
    const auto num_robots = states.num_robots(state);
    workspace.cells.resize(num_robots);
    workspace.seen_in.resize(std::max(workspace.seen_in.size(), grid.blocked.size()), 0);
    const std::int32_t* next = states.positions + states.offsets[state] * 2;
    for (std::size_t robot = 0; robot < num_robots; ++robot) {
        const int row = *next++, col = *next++;
        if (!grid.layout.contains(row, col)) reject(state, robot, row, col, "lies outside the map");
        const int cell = grid.layout.cell(row, col);
        if (grid.blocked[cell]) reject(state, robot, row, col, "lies on an obstacle");
        if (workspace.distances.to_goal_of(robot)[cell] == unreachable)
            reject(state, robot, row, col, "cannot reach its goal: obstacles separate them");
        if (workspace.seen_in[cell] == state + 1) reject(state, robot, row, col, "shares its cell with another agent");
        workspace.seen_in[cell] = state + 1;
        workspace.cells[robot] = cell;
    }
}

}  // namespace

void relabel(const std::vector<GoalsOnGrid>& problems, const States& states, const EcbsOptions& options, int threads,
             Interrupt& interrupt, std::int8_t* actions, bool* solved) {
    std::vector<std::size_t> order(states.count);
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::stable_sort(order.begin(), order.end(),
                     [&](std::size_t a, std::size_t b) { return states.problem_of[a] < states.problem_of[b]; });
    const auto jobs = cut_into_jobs(states, order);
    run_jobs<Workspace>(jobs.size(), threads, interrupt, [&](std::size_t job, Workspace& workspace, bool polls) {
        const auto which = states.problem_of[order[jobs[job].begin]];
        const auto& [grid, goals] = problems[static_cast<std::size_t>(which)];
        Budget budget(std::numeric_limits<double>::infinity(), interrupt, polls);
        if (workspace.problem != which && !workspace.distances.compute(grid, goals, budget)) return;
        workspace.problem = which;
        for (std::size_t i = jobs[job].begin; i < jobs[job].end; ++i) {
            const auto state = order[i];
            read_state(states, state, grid, workspace);
            const Problem problem{grid, workspace.cells, goals, workspace.distances};
            solved[state] = workspace.ecbs.solve(problem, options, budget) == Status::solved;
            std::int8_t* next = actions + states.offsets[state];
            for (std::size_t robot = 0; robot < states.num_robots(state); ++robot) {
                std::int8_t& action = *next++;
                action = idle;
                if (!solved[state]) continue;
                const auto path = workspace.ecbs.actions(robot);
                if (!path.empty()) action = static_cast<std::int8_t>(path[0]);
            }
        }
    });
}

}  // namespace mapf
