// Random teams under all options of the native core, to be run with AddressSanitizer and UBSan:
//   c++ -std=c++20 -g -O1 -fsanitize=address,undefined -fno-sanitize-recover=all -I. tests/native/fuzz_world.cpp
//     mapf_env/native/graph.cpp mapf_env/native/generate.cpp mapf_env/native/observe.cpp mapf_env/native/senses.cpp
//     -o fuzz_world && ./fuzz_world SECONDS
// Every buffer has exactly the size that it needs, and every executed step is checked for conflicts.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/generate.hpp"
#include "mapf_env/native/senses.hpp"
#include "mapf_env/native/team_step.hpp"

namespace {

using namespace mapf;

void require(bool holds, const char* what, std::uint64_t seed) {
    if (holds) return;
    std::printf("seed %llu: %s\n", static_cast<unsigned long long>(seed), what);
    std::exit(1);
}

template <class T>
void play(std::uint64_t seed) {
    Random random(seed);
    const int height = 1 + random.below(12), width = 2 + random.below(12), radius = 1 + random.below(6);
    const auto style = static_cast<Style>(random.below(6));
    const int obstacles = style == Style::cells ? random.below(height * width / 3 + 1) : 0;
    const Parts parts{1 + random.below(4), random.below(3) / 2.0, 1 + random.below(7), 1 + random.below(5),
                      1 + random.below(3)};
    const Grid grid = random_map(style, parts, height, width, obstacles, random);
    int free = 0;
    for (const auto cell : grid.blocked) free += cell == 0;
    if (free < 2) return;
    const int n = 1 + random.below(std::min(free, 12));
    const std::size_t N = n + random.below(3);

    Teams<T> teams{};
    teams.layout = {height, width, radius};
    teams.num_envs = 1;
    teams.num_agents = N;
    const std::size_t size = teams.layout.size();
    const std::size_t area = static_cast<std::size_t>(height) * width;
    std::vector<std::uint8_t> drawn(area);
    for (int row = 0; row < height; ++row)
        for (int col = 0; col < width; ++col) drawn[row * width + col] = grid.blocked[grid.layout.cell(row, col)];
    std::vector<std::int32_t> starts(2 * N), ends(2 * N);
    place_agents(grid, n, random, starts.data(), ends.data());

    Options options;
    options.pibt = random.below(2);
    options.swap = random.below(2);
    options.lifelong = random.below(2);
    options.message_loss = random.below(3) / 2.0;
    const auto some = [&](auto rows) {
        std::vector<std::string> names;
        for (const auto& row : rows)
            if (random.below(2)) names.emplace_back(row.name);
        return names;
    };
    const auto weights = static_cast<Weights>(random.below(2));
    options.senses = Senses(radius, 1 + random.below(history), weights, some(channels().subspan(num_channels)),
                            some(robot_features()), some(edge_features()));
    options.rewards = {1.0f, -1.0f, 0.5f, -0.5f, 3.0f, static_cast<float>(random.below(2))};

    options.comm_radius = 0.5 + random.below(5);
    options.connected = random.below(2);

    std::int32_t team_size = 0;
    std::uint64_t episode = 0;
    double comm_radius = 0.0;
    std::int64_t time = 0;
    std::int32_t max_cycles = 0;
    std::vector<T> map(size, T{1});
    std::vector<std::int32_t> positions(2 * N), goals(2 * N), previous(2 * N), under_way(N), arrivals(N), regions(size, -1);
    teams.table = {teams.layout.rows(), teams.layout.stride()};
    if (random.below(2)) {  // a part of the map, at least as large as what a robot sees
        teams.table.rows = 2 * radius + 1 + random.below(teams.table.rows - 2 * radius);
        teams.table.cols = 2 * radius + 1 + random.below(teams.table.cols - 2 * radius);
    }
    std::vector<Distance> distances(N * teams.table.size());
    std::vector<std::int32_t> corners(2 * N);
    std::unique_ptr<bool[]> cells_blocked(new bool[area]());
    bool started = false, ended = true, terminated = false, truncated = false;
    std::vector<float> rewards(N), graph(N * N);
    std::unique_ptr<bool[]> replaced(new bool[N]()), arrived(new bool[N]()), on_goal(new bool[N]());
    std::vector<std::int8_t> mask(N * num_actions);
    std::vector<std::int8_t> moves(N * history);
    std::vector<T> fov(N * options.senses.view());
    std::vector<float> scalars(N * options.senses.robot_columns), edge_attr(N * N * options.senses.edge_columns);
    teams.grids = cells_blocked.get(), teams.started = &started;
    teams.obstacles = map.data(), teams.team_sizes = &team_size, teams.seeds = &episode, teams.comm_radius = &comm_radius;
    teams.regions = regions.data(), teams.positions = positions.data(), teams.goals = goals.data();
    teams.moves = moves.data(), teams.max_cycles = &max_cycles, teams.under_way = under_way.data(), teams.arrivals = arrivals.data();
    teams.distances = distances.data(), teams.corners = corners.data(), teams.times = &time, teams.ended = &ended, teams.rewards = rewards.data();
    teams.terminated = &terminated, teams.truncated = &truncated, teams.replaced = replaced.get();
    teams.arrived = arrived.get(), teams.on_goal = on_goal.get(), teams.action_mask = mask.data();

    begin_team(teams, options, 0, seed, 1 + random.below(40), prepare_episode(teams, drawn.data(), starts.data(), ends.data(), n));
    for (int i = 0; i < 2 * n; ++i) require(positions[i] == starts[i] && goals[i] == ends[i], "another case began", seed);
    for (std::size_t i = 0; i < area; ++i) require(cells_blocked[i] == (drawn[i] != 0), "another map", seed);

    TeamScratch<T> scratch(teams.layout, static_cast<int>(N));
    std::vector<std::int64_t> actions(N);
    std::vector<float> scores(N * num_actions);
    std::vector<int> standing;
    while (!ended) {
        for (auto& action : actions) action = random.below(num_actions);
        for (auto& score : scores) score = static_cast<float>(random.below(7));
        const bool by_scores = options.pibt && random.below(2);
        previous = positions;
        step_team(teams, options, 0, {actions.data(), by_scores ? scores.data() : nullptr}, scratch);
        perceive(teams, options, 0, scratch, Percepts<T>{fov.data(), graph.data(), scalars.data(), edge_attr.data()});
        std::vector<Edge> edges;
        find_edges(teams.layout, positions.data(), n, comm_radius, weights, options.message_loss,
                   message_key(episode, time), standing, edges);
        std::vector<float> same(N * N);
        for (const Edge& edge : edges) same[edge.receiver * N + edge.sender] = edge.weight;
        require(same == graph, "the edges are not those of the graph", seed);
        write_action_mask(teams, 0);
        std::set<int> cells;
        std::set<std::pair<int, int>> ways;
        for (int i = 0; i < n; ++i) {
            const int from = teams.layout.cell(previous[2 * i], previous[2 * i + 1]);
            const int to = teams.layout.cell(positions[2 * i], positions[2 * i + 1]);
            require(teams.layout.contains(positions[2 * i], positions[2 * i + 1]), "a robot left the map", seed);
            require(map[to] == T{0}, "a robot entered an obstacle", seed);
            require(cells.insert(to).second, "two robots in one cell", seed);
            require(from == to || ways.count({to, from}) == 0, "two robots exchanged cells", seed);
            ways.insert({from, to});
        }
        for (const T mark : scratch.marks) require(mark == T{0}, "marks were left", seed);
    }
}

}  // namespace

int main(int count, char** arguments) {
    const double seconds = count > 1 ? std::atof(arguments[1]) : 10.0;
    const auto began = std::chrono::steady_clock::now();
    std::uint64_t seed = 0;
    for (; std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count() < seconds; ++seed)
        seed % 2 ? play<float>(seed) : play<std::uint8_t>(seed);
    std::printf("%llu episodes without a fault\n", static_cast<unsigned long long>(seed));
}
