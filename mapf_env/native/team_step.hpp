// One joint step of a team, from wanted actions to new observations, in one pass while its data are in the cache.
//
// The state of all teams lies in flat arrays, environments first (struct Teams). Robot i of team b has row b * N + i:
//
//     team 0          team 1          team 2
//     r0 r1 r2 --     r0 r1 -- --     r0 r1 r2 r3        N = 4 rows for each team; "--" is a robot that is not there
//
// An episode is the calls
//
//     prepare_episode   checks what the team begins with and finds its distance tables, if any sense needs them
//     begin_team        writes the start state
//     step_team         shield, move, reward, record, end; in lifelong tasks new goals (the steps are named there)
//     perceive          writes the views, the communication graph and the features of robots and links
//
// Invariants: the rows of different teams are disjoint, so threads step teams without locks; every random draw is a
// function of the episode's seed, the time and the robot, so results do not depend on the number of threads.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <cstring>
#include <vector>

#include "mapf_env/native/goals.hpp"
#include "mapf_env/native/graph.hpp"
#include "mapf_env/native/grid.hpp"
#include "mapf_env/native/observe.hpp"
#include "mapf_env/native/pibt_shield.hpp"
#include "mapf_env/native/random.hpp"
#include "mapf_env/native/senses.hpp"
#include "mapf_env/native/shield.hpp"
#include "mapf_env/native/ways.hpp"

namespace mapf {

// The reward of a robot in a step is the sum of the parts that apply.
struct Rewards {
    float on_goal, off_goal, arrival, replaced, solved, closer;
};

struct Options {
    Senses senses;
    bool pibt = false, swap = false, lifelong = false;
    double message_loss = 0.0;
    double comm_radius = 0.0;
    bool connected = false;  // comm_radius grows at the beginning until the team is connected
    Rewards rewards{};
};

// The arrays of B teams of at most N robots, environments first. Of team b the first team_sizes[b] robots are there.
template <class T>
struct Teams {
    Layout layout;
    std::size_t num_envs, num_agents;
    bool* grids;                    // (B, height, width)
    T* obstacles;                   // (B, layout.size())
    std::int32_t* team_sizes;       // (B)
    std::uint64_t* seeds;           // (B) of the episodes
    double* comm_radius;            // (B)
    std::int32_t* regions;          // (B, layout.size()), only if goals change
    std::int32_t *positions, *goals;  // (B, N, 2)
    std::int8_t* moves;             // (B, N, history) executed moves, newest first; -1 before the start
    std::int32_t* under_way;        // (B, N) steps since the robot was on its goal
    std::int32_t* arrivals;         // (B, N) how often it has arrived
    TableShape table;               // of each robot, at least as far as it sees
    Distance* distances;            // (B, N, rows, cols) steps to the goals around the robots, only where they are asked for
    std::int32_t* corners;          // (B, N, 2) where the tables lie, as of `place_table`
    std::int64_t* times;            // (B)
    std::int32_t* max_cycles;       // (B) steps after which the episode is truncated
    bool *started, *ended;          // (B)
    // The outcome of the last step.
    float* rewards;                 // (B, N)
    bool *terminated, *truncated;   // (B)
    bool *replaced, *arrived, *on_goal;  // (B, N)
    std::int8_t* action_mask;       // (B, N, 5)
};

// Memory for the steps of one thread, on cache lines of its own.
template <class T>
struct alignas(64) TeamScratch {
    ShieldScratch shield;
    PibtScratch<T> pibt;
    std::vector<T> marks;
    std::vector<std::uint8_t> taken, greedy;
    std::vector<std::int8_t> executed;
    std::vector<int> standing;
    std::vector<float> rows, cols;
    std::vector<int> goal_cells, order, ends;
    GoalSearch<T> search;

    TeamScratch(const Layout& layout, int num_agents)
        : shield(layout, num_agents), pibt(layout, num_agents), marks(layout.size(), T{0}), taken(layout.size(), 0),
          executed(num_agents), goal_cells(num_agents) {}
};

// The start of an episode: its instance and, if a sense needs them, its distance tables.
struct EpisodeStart {
    const std::uint8_t* grid;             // (height, width)
    const std::int32_t *starts, *goals;   // (N, 2)
    int size;                             // robots that are there
    std::vector<Distance> distances;      // (size, rows, cols), if they are asked for
    std::vector<std::int32_t> corners;    // (size, 2)
};

// Throws std::invalid_argument if a way is too long to be counted.
template <class T>
EpisodeStart prepare_episode(const Teams<T>& teams, const std::uint8_t* grid, const std::int32_t* starts, const std::int32_t* goals,
                int size) {
    EpisodeStart result{grid, starts, goals, size, {}, {}};
    if (teams.distances == nullptr) return result;
    const auto& layout = teams.layout;
    std::vector<std::uint8_t> blocked(layout.size(), 1);
    for (int row = 0; row < layout.height; ++row)
        std::copy_n(grid + static_cast<std::size_t>(row) * layout.width, layout.width, &blocked[layout.cell(row, 0)]);
    GoalSearch<std::uint8_t> search;
    search.on(layout, blocked.data());
    result.distances.resize(size * teams.table.size());
    result.corners.resize(2 * static_cast<std::size_t>(size));
    for (int i = 0; i < size; ++i)
        search.fill(layout.cell(goals[2 * i], goals[2 * i + 1]), starts[2 * i], starts[2 * i + 1], teams.table,
                    &result.corners[2 * i], &result.distances[i * teams.table.size()]);
    return result;
}

// Begins an episode of team b, which is truncated after `limit` steps.
template <class T>
void begin_team(const Teams<T>& teams, const Options& options, std::size_t b, std::uint64_t seed, std::int32_t limit,
                const EpisodeStart& episode) {
    const auto& layout = teams.layout;
    const std::size_t N = teams.num_agents, first = b * N, size = layout.size();
    const std::size_t area = static_cast<std::size_t>(layout.height) * layout.width;
    T* obstacles = teams.obstacles + b * size;
    bool* grid = teams.grids + b * area;
    for (std::size_t cell = 0; cell < area; ++cell) grid[cell] = episode.grid[cell] != 0;
    for (int row = 0; row < layout.height; ++row)
        std::transform(grid + row * layout.width, grid + (row + 1) * layout.width, obstacles + layout.cell(row, 0),
                       [](bool blocked) { return static_cast<T>(blocked); });
    if (teams.regions != nullptr) {
        const auto regions = regions_of(grid_of(layout, obstacles));
        std::copy(regions.begin(), regions.end(), teams.regions + b * size);
    }
    if (teams.distances != nullptr) {
        std::copy(episode.distances.begin(), episode.distances.end(), teams.distances + first * teams.table.size());
        std::copy(episode.corners.begin(), episode.corners.end(), teams.corners + 2 * first);
    }
    std::copy_n(episode.starts, 2 * N, teams.positions + 2 * first);
    std::copy_n(episode.goals, 2 * N, teams.goals + 2 * first);
    std::fill_n(teams.moves + first * history, N * history, std::int8_t{-1});
    for (std::size_t i = 0; i < N; ++i) {
        const std::int32_t *start = episode.starts + 2 * i, *goal = episode.goals + 2 * i;
        teams.on_goal[first + i] = static_cast<int>(i) < episode.size && start[0] == goal[0] && start[1] == goal[1];
    }
    std::fill_n(teams.under_way + first, N, 0);
    std::fill_n(teams.arrivals + first, N, 0);
    teams.team_sizes[b] = episode.size;
    teams.seeds[b] = seed;
    teams.comm_radius[b] = options.connected ? connecting_radius(episode.starts, episode.size, options.comm_radius)
                                             : options.comm_radius;
    teams.times[b] = 0;
    teams.max_cycles[b] = limit;
    teams.started[b] = true;
    teams.ended[b] = false;
}

// The tables of team b.
template <class T>
WayTables ways_of(const Teams<T>& teams, std::size_t b) {
    const std::size_t first = b * teams.num_agents;
    return {teams.distances + first * teams.table.size(), teams.corners + 2 * first, teams.table};
}

// Fills the table of a robot of team b around where it stands. The search is on the team's map.
template <class T>
void find_way(const Teams<T>& teams, std::size_t b, int i, GoalSearch<T>& search) {
    const std::size_t robot = b * teams.num_agents + i;
    const std::int32_t *position = teams.positions + 2 * robot, *goal = teams.goals + 2 * robot;
    search.fill(teams.layout.cell(goal[0], goal[1]), position[0], position[1], teams.table, teams.corners + 2 * robot,
                teams.distances + robot * teams.table.size());
}

// Fills the tables again that do not reach as far as their robots see.
template <class T>
void renew_ways(const Teams<T>& teams, int radius, std::size_t b, GoalSearch<T>& search) {
    if (teams.distances == nullptr || teams.table.is_whole(teams.layout)) return;
    const WayTables ways = ways_of(teams, b);
    const std::int32_t* positions = teams.positions + 2 * b * teams.num_agents;
    for (int i = 0; i < teams.team_sizes[b]; ++i)
        if (!ways.covers(teams.layout, i, positions[2 * i], positions[2 * i + 1], radius))
            find_way(teams, b, i, search);
}

// The facts of team b that senses read, with distances and greedy moves if a sense needs them.
template <class T>
TeamFacts facts_of(const Teams<T>& teams, std::size_t b, bool needs_map, TeamScratch<T>& scratch) {
    const std::size_t first = b * teams.num_agents;
    TeamFacts team;
    team.layout = teams.layout;
    team.num_agents = teams.team_sizes[b];
    team.positions = teams.positions + 2 * first;
    team.goals = teams.goals + 2 * first;
    team.moves = teams.moves + first * history;
    team.under_way = teams.under_way + first;
    team.seed = teams.seeds[b];
    team.time = teams.times[b];
    team.limit = teams.max_cycles[b];
    team.comm_radius = teams.comm_radius[b];
    if (needs_map) {
        team.ways = ways_of(teams, b);
        find_greedy_moves(team, scratch.greedy);
        team.greedy = scratch.greedy.data();
    }
    team.order = order_by_tile(team.layout, team.positions, team.num_agents, scratch.order, scratch.ends);
    return team;
}

// The key by which the messages of a team are lost at a time.
inline std::uint64_t message_key(std::uint64_t seed, std::int64_t time) {
    return mix(seed_for(Use::messages, seed), static_cast<std::uint64_t>(time));
}

// Memory for what one team perceives.
template <class T>
struct Percepts {
    T* fov;            // (N, planes, side, side)
    float* graph;      // (N, N)
    float* scalars;    // (N, robot_columns), if there are any
    float* edge_attr;  // (N, N, edge_columns), if there are any
};

// Writes what team b perceives; zeros for robots that are not there, and for the features of edges that do not exist.
template <class T>
void perceive(const Teams<T>& teams, const Options& options, std::size_t b, TeamScratch<T>& scratch,
              const Percepts<T>& out) {
    const auto& layout = teams.layout;
    const auto& senses = options.senses;
    const std::size_t N = teams.num_agents, view = senses.view();
    const std::size_t scalars = senses.robot_columns, attributes = senses.edge_columns;
    const TeamFacts team = facts_of(teams, b, senses.needs_map, scratch);
    const std::size_t n = team.num_agents;
    write_views(senses, team, teams.obstacles + b * layout.size(), scratch.marks.data(), out.fov);
    const int stride = static_cast<int>(N);
    communication_graph(team.positions, team.num_agents, team.comm_radius, senses.weights, stride, scratch.rows,
                        scratch.cols, out.graph);
    if (options.message_loss > 0.0)
        lose_messages(team.num_agents, options.message_loss, message_key(team.seed, team.time), stride, out.graph);
    if (scalars > 0) write_robot_features(senses, team, out.scalars);
    if (attributes > 0) {
        std::fill_n(out.edge_attr, N * N * attributes, 0.0f);
        for (std::size_t i = 0; i < n; ++i)
            for (std::size_t j = 0; j < n; ++j)
                if (out.graph[i * N + j] != 0.0f)
                    write_edge_features(senses, team, static_cast<int>(i), static_cast<int>(j),
                                        out.edge_attr + (i * N + j) * attributes);
    }
    if (n < N) {
        std::fill_n(out.fov + n * view, (N - n) * view, T{0});
        for (std::size_t i = 0; i < n; ++i) std::fill_n(out.graph + i * N + n, N - n, 0.0f);
        std::fill_n(out.graph + n * N, (N - n) * N, 0.0f);
        if (scalars > 0) std::fill_n(out.scalars + n * scalars, (N - n) * scalars, 0.0f);
    }
}

// Writes which actions neither leave the map nor enter an obstacle; a robot that is not there can only idle.
template <class T>
void write_action_mask(const Teams<T>& teams, std::size_t b) {
    const auto& layout = teams.layout;
    const auto steps = layout.steps();
    const T* map = teams.obstacles + b * layout.size();
    for (std::size_t i = b * teams.num_agents; i < (b + 1) * teams.num_agents; ++i) {
        if (i - b * teams.num_agents >= static_cast<std::size_t>(teams.team_sizes[b])) {
            for (int action = 0; action < num_actions; ++action)
                teams.action_mask[i * num_actions + action] = action == idle;
            continue;
        }
        const int cell = layout.cell(teams.positions[2 * i], teams.positions[2 * i + 1]);
        for (int action = 0; action < num_actions; ++action)
            teams.action_mask[i * num_actions + action] = map[cell + steps[action]] == T{0};
    }
}

// A new goal for each robot of team b that is on its goal; without an arrival if it began there or found no other goal.
template <class T>
void give_goals(const Teams<T>& teams, std::size_t b, TeamScratch<T>& scratch) {
    const auto& layout = teams.layout;
    const std::size_t first = b * teams.num_agents;
    const int n = teams.team_sizes[b];
    bool* on_goal = teams.on_goal + first;
    if (std::none_of(on_goal, on_goal + n, [](bool robot) { return robot; })) return;
    std::int32_t* goals = teams.goals + 2 * first;
    mark(layout, goals, n, std::uint8_t{1}, scratch.taken.data());
    for (int i = 0; i < n; ++i) {
        if (!on_goal[i]) continue;
        const bool is_new = draw_goal(layout, teams.regions + b * layout.size(), teams.positions + 2 * (first + i),
                                      goal_random(teams.seeds[b], i, teams.arrivals[first + i]), scratch.taken.data(),
                                      goals + 2 * i);
        if (!is_new) continue;
        on_goal[i] = false;
        if (teams.distances != nullptr) find_way(teams, b, i, scratch.search);
    }
    mark(layout, goals, n, std::uint8_t{0}, scratch.taken.data());
}

// Puts a move in front of the last moves (history) of a robot; the oldest is forgotten.
inline void remember(std::int8_t move, std::int8_t* moves) {
    static_assert(history == 16);
    if constexpr (std::endian::native == std::endian::little) {  // two shifts of words
        std::uint64_t words[2];
        std::memcpy(words, moves, history);
        words[1] = words[1] << 8 | words[0] >> 56;
        words[0] = words[0] << 8 | static_cast<std::uint8_t>(move);
        std::memcpy(moves, words, history);
    } else {
        std::memmove(moves + 1, moves, history - 1);
        moves[0] = move;
    }
}

// The wanted actions of all teams: one action each (B, N), or a score for each of the five (B, N, 5). The pointer to
// the form that is not used is null.
struct JointAction {
    const std::int64_t* actions;
    const float* scores;
};

// Step 1 with the shield "pibt" or "pibt_swap": every robot gets the best action of its preference order that the
// robots of higher priority leave it.
template <class T>
void shield_by_pibt(const Teams<T>& teams, const Options& options, std::size_t b, JointAction wanted,
                    TeamScratch<T>& scratch) {
    const auto& layout = teams.layout;
    const std::size_t first = b * teams.num_agents;
    const int n = teams.team_sizes[b];
    const T* obstacles = teams.obstacles + b * layout.size();
    const std::int32_t *positions = teams.positions + 2 * first, *under_way = teams.under_way + first;
    const std::uint64_t seed = teams.seeds[b], priorities = seed_for(Use::priorities, seed);
    const std::uint64_t key = mix(seed_for(Use::preferences, seed), static_cast<std::uint64_t>(teams.times[b]));
    std::uint8_t* preferences = scratch.pibt.preferences.data();
    std::int8_t* executed = scratch.executed.data();

    for (int i = 0; i < n; ++i)
        if (wanted.scores != nullptr)
            prefer_scores(wanted.scores + (first + i) * num_actions, preferences + i * num_actions);
        else
            prefer_action(static_cast<int>(wanted.actions[first + i]), mix(key, i), preferences + i * num_actions);
    if (options.swap) {
        const std::int32_t* goals = teams.goals + 2 * first;
        auto& cells = scratch.goal_cells;
        for (int i = 0; i < n; ++i) cells[i] = layout.cell(goals[2 * i], goals[2 * i + 1]);
        const WaySwaps<T> swaps{layout, cells.data(), ways_of(teams, b), scratch.search};
        pibt_shield(layout, obstacles, positions, under_way, n, priorities, scratch.pibt, executed, swaps);
    } else {
        pibt_shield(layout, obstacles, positions, under_way, n, priorities, scratch.pibt, executed);
    }
    for (int i = 0; i < n; ++i) teams.replaced[first + i] = executed[i] != preferences[i * num_actions];
}

// Step 1 with the shield "idle": wanted actions that would collide become idle.
template <class T>
void shield_by_idling(const Teams<T>& teams, std::size_t b, JointAction wanted, TeamScratch<T>& scratch) {
    const std::size_t first = b * teams.num_agents;
    const int n = teams.team_sizes[b];
    const std::uint64_t ties = seed_for(Use::ties, teams.seeds[b]), time = teams.times[b];
    std::int8_t* executed = scratch.executed.data();
    const T* obstacles = teams.obstacles + b * teams.layout.size();
    shield(teams.layout, obstacles, teams.positions + 2 * first, wanted.actions + first, n, mix(ties, time),
           scratch.shield, executed);
    for (int i = 0; i < n; ++i) teams.replaced[first + i] = executed[i] != wanted.actions[first + i];
}

// Step 2: moves the robots, sets on_goal and arrived, and begins the rewards. Returns true if all are on their goals.
template <class T>
bool move_robots(const Teams<T>& teams, const Rewards& scheme, std::size_t b, const std::int8_t* executed) {
    const std::size_t first = b * teams.num_agents;
    const int n = teams.team_sizes[b];
    std::int32_t* positions = teams.positions + 2 * first;
    const std::int32_t* goals = teams.goals + 2 * first;
    float* rewards = teams.rewards + first;
    bool *on_goal = teams.on_goal + first, *arrived = teams.arrived + first;
    const bool* replaced = teams.replaced + first;
    bool all_on_goal = true;
    for (int i = 0; i < n; ++i) {
        const int row = positions[2 * i], col = positions[2 * i + 1];
        const int goal_row = goals[2 * i], goal_col = goals[2 * i + 1];
        const int new_row = row + row_step[executed[i]], new_col = col + col_step[executed[i]];
        const bool was_there = (row == goal_row) & (col == goal_col);
        const bool is_there = (new_row == goal_row) & (new_col == goal_col);
        const bool arrives = is_there & !was_there;
        positions[2 * i] = new_row;
        positions[2 * i + 1] = new_col;
        all_on_goal &= is_there;
        on_goal[i] = is_there;
        arrived[i] = arrives;
        rewards[i] = (is_there ? scheme.on_goal : scheme.off_goal) + (arrives ? scheme.arrival : 0.0f) +
                     (replaced[i] ? scheme.replaced : 0.0f);
    }
    return all_on_goal;
}

// Step 3: counts arrivals and the steps under way, and puts the executed moves into the robots' histories.
template <class T>
void record_moves(const Teams<T>& teams, std::size_t b, const std::int8_t* executed) {
    const std::size_t first = b * teams.num_agents;
    const int n = teams.team_sizes[b];
    for (int i = 0; i < n; ++i) {
        teams.arrivals[first + i] += teams.arrived[first + i];
        teams.under_way[first + i] = teams.on_goal[first + i] ? 0 : teams.under_way[first + i] + 1;
    }
    for (int i = 0; i < n; ++i) remember(executed[i], teams.moves + (first + i) * history);
}

// Step 4: adds the reward for every step by which the distance to the goal has become shorter.
template <class T>
void reward_progress(const Teams<T>& teams, float closer, std::size_t b, const std::int8_t* executed) {
    const std::size_t first = b * teams.num_agents;
    const std::int32_t* positions = teams.positions + 2 * first;
    const WayTables ways = ways_of(teams, b);
    for (int i = 0; i < teams.team_sizes[b]; ++i) {
        const Distance* const way = ways.at(teams.layout, i, positions[2 * i], positions[2 * i + 1]);
        const int back = row_step[executed[i]] * ways.shape.cols + col_step[executed[i]];
        teams.rewards[first + i] += closer * static_cast<float>(way[-back] - way[0]);
    }
}

// Step 5: clears the outcome of robots that are not there.
template <class T>
void clear_absent(const Teams<T>& teams, std::size_t b) {
    const std::size_t absent = b * teams.num_agents + teams.team_sizes[b], end = (b + 1) * teams.num_agents;
    if (absent == end) return;
    std::fill_n(teams.rewards + absent, end - absent, 0.0f);
    for (bool* flags : {teams.replaced, teams.arrived, teams.on_goal}) std::fill_n(flags + absent, end - absent, false);
}

// Step 6: advances the time, and ends the episode if the team has solved it or its time is over.
template <class T>
void end_or_continue(const Teams<T>& teams, const Options& options, std::size_t b, bool all_on_goal) {
    teams.times[b] += 1;
    // The flags of 64 teams share a cache line, for which threads would contend: it is written only if one changes.
    const auto update = [](bool& flag, bool value) {
        if (flag != value) flag = value;
    };
    const bool terminated = all_on_goal && !options.lifelong;
    update(teams.terminated[b], terminated);
    update(teams.truncated[b], !terminated && teams.times[b] >= teams.max_cycles[b]);
    update(teams.ended[b], terminated || teams.truncated[b]);
    if (!terminated) return;
    float* rewards = teams.rewards + b * teams.num_agents;
    for (int i = 0; i < teams.team_sizes[b]; ++i) rewards[i] += options.rewards.solved;
}

// Executes one joint action of team b, which the caller has checked:
//
//     wanted --shield--> executed --move--> positions --> rewards, arrivals, history --> ended? --> new goals --> ways
//
// Invariant: no two robots of a team share a cell, before and after; the shield alone sees to that, and no later step
// changes an action.
template <class T>
void step_team(const Teams<T>& teams, const Options& options, std::size_t b, JointAction wanted,
               TeamScratch<T>& scratch) {
    const std::int8_t* executed = scratch.executed.data();
    scratch.search.on(teams.layout, teams.obstacles + b * teams.layout.size());
    if (options.pibt)
        shield_by_pibt(teams, options, b, wanted, scratch);
    else
        shield_by_idling(teams, b, wanted, scratch);
    const bool all_on_goal = move_robots(teams, options.rewards, b, executed);
    record_moves(teams, b, executed);
    if (options.rewards.closer != 0.0f) reward_progress(teams, options.rewards.closer, b, executed);
    clear_absent(teams, b);
    end_or_continue(teams, options, b, all_on_goal);
    if (options.lifelong) give_goals(teams, b, scratch);
    renew_ways(teams, options.senses.fov_radius, b, scratch.search);
}

}  // namespace mapf
