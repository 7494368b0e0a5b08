#include "mapf_env/native/graph.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <limits>
#include <numeric>
#include <utility>

#include "mapf_env/native/random.hpp"
#include "mapf_env/native/wide.hpp"

namespace mapf {

namespace {

MAPF_WIDE void write_rows(const float* rows, const float* cols, int num_agents, float limit, bool binary, int stride,
                          float* out) {
    for (int i = 0; i < num_agents; ++i, out += stride) {
        const float row = rows[i], col = cols[i];
        if (binary)
            for (int j = 0; j < num_agents; ++j) {
                const float down = row - rows[j], right = col - cols[j];
                out[j] = down * down + right * right < limit ? 1.0f : 0.0f;
            }
        else
            for (int j = 0; j < num_agents; ++j) {
                const float down = row - rows[j], right = col - cols[j], square = down * down + right * right;
                out[j] = square < limit ? 1.0f / std::sqrt(square) : 0.0f;
            }
        out[i] = 0.0f;
    }
}

// The least squared distance that is too far to hear. Squared distances are whole numbers, exact in float up to maps of
// 2896 x 2896 cells.
float least_too_far(double radius) {
    double nearest = std::floor(radius * radius);
    if (std::sqrt(nearest) < radius) ++nearest;
    return static_cast<float>(nearest);
}

bool is_lost(std::uint64_t key, int receiver, int sender, double loss) {
    return uniform(mix(mix(key, receiver), sender)) < loss;
}

constexpr double infinity = std::numeric_limits<double>::infinity();

double length(double down, double right) { return std::sqrt(down * down + right * right); }

// The least rectangle around some cells.
struct Box {
    double top = infinity, bottom = -infinity, left = infinity, right = -infinity;

    void add(const std::int32_t* cell) {
        top = std::min<double>(top, cell[0]);
        bottom = std::max<double>(bottom, cell[0]);
        left = std::min<double>(left, cell[1]);
        right = std::max<double>(right, cell[1]);
    }

    double distance(const Box& other) const {
        return length(std::max({other.top - bottom, top - other.bottom, 0.0}),
                      std::max({other.left - right, left - other.right, 0.0}));
    }
};

// Sets of robots that are joined (Galler and Fischer 1964).
class JoinedRobots {
public:
    explicit JoinedRobots(int count) : parent_(count), num_sets_(count) {
        std::iota(parent_.begin(), parent_.end(), 0);
    }

    int num_sets() const { return num_sets_; }

    int root(int i) {
        while (parent_[i] != i) i = parent_[i] = parent_[parent_[i]];
        return i;
    }

    void join(int i, int j) {
        i = root(i);
        j = root(j);
        num_sets_ -= i != j;
        parent_[i] = j;
    }

private:
    std::vector<int> parent_;
    int num_sets_;
};

// Returns true if links shorter than `radius` connect all robots. The map is cut into squares so small that all robots
// of one hear each other and so large that none hears a robot three squares away. Robots of two squares are compared only
// if nothing has joined these yet.
bool is_connected(const std::int32_t* positions, int num_agents, double radius) {
    struct Square {
        std::array<double, 2> place;
        std::size_t begin, end;  // of its robots
        Box box;
    };
    const double side = std::max(std::floor(radius / 1.42), 1.0);
    std::vector<std::pair<std::array<double, 2>, int>> robots(num_agents);
    for (int i = 0; i < num_agents; ++i)
        robots[i] = {{std::floor(positions[2 * i] / side), std::floor(positions[2 * i + 1] / side)}, i};
    std::sort(robots.begin(), robots.end());
    JoinedRobots joined(num_agents);
    std::vector<Square> squares;
    for (std::size_t k = 0; k < robots.size(); ++k) {
        if (k == 0 || robots[k].first != squares.back().place) squares.push_back({robots[k].first, k, k, {}});
        Square& square = squares.back();
        square.box.add(positions + 2 * robots[k].second);
        square.end = k + 1;
        joined.join(robots[k].second, robots[square.begin].second);
    }
    const auto compare = [&](const Square& one, const Square& other) {
        if (joined.root(robots[one.begin].second) == joined.root(robots[other.begin].second)) return;
        if (!(one.box.distance(other.box) < radius)) return;
        for (std::size_t a = one.begin; a < one.end; ++a)
            for (std::size_t b = other.begin; b < other.end; ++b) {
                const int i = robots[a].second, j = robots[b].second;
                const double down = positions[2 * i] - static_cast<double>(positions[2 * j]);
                const double right = positions[2 * i + 1] - static_cast<double>(positions[2 * j + 1]);
                if (length(down, right) < radius) return joined.join(i, j);
            }
    };
    constexpr std::array<std::array<int, 2>, 12> ahead{
        {{0, 1}, {1, 0}, {1, 1}, {1, -1}, {0, 2}, {2, 0}, {1, 2}, {2, 1}, {1, -2}, {2, -1}, {2, 2}, {2, -2}}};
    for (const auto& [down, right] : ahead) {
        for (const Square& square : squares) {
            const std::array<double, 2> place{square.place[0] + down, square.place[1] + right};
            const auto other = std::lower_bound(squares.begin(), squares.end(), place,
                                                [](const Square& each, const auto& key) { return each.place < key; });
            if (other != squares.end() && other->place == place) compare(square, *other);
        }
        if (joined.num_sets() == 1) return true;
    }
    return false;
}

}  // namespace

void communication_graph(const std::int32_t* positions, int num_agents, double radius, Weights weights, int stride,
                         std::vector<float>& rows, std::vector<float>& cols, float* out) {
    rows.resize(num_agents);
    cols.resize(num_agents);
    for (int i = 0; i < num_agents; ++i) {
        rows[i] = static_cast<float>(positions[2 * i]);
        cols[i] = static_cast<float>(positions[2 * i + 1]);
    }
    write_rows(rows.data(), cols.data(), num_agents, least_too_far(radius), weights == Weights::binary, stride, out);
}

void find_edges(const Layout& layout, const std::int32_t* positions, int num_agents, double radius, Weights weights,
                double loss, std::uint64_t key, std::vector<int>& standing, std::vector<Edge>& edges,
                const int* order) {
    const float limit = least_too_far(radius);
    const auto add = [&](int i, int j, int row, int col) {  // j stands at (row, col)
        const float down = static_cast<float>(positions[2 * i]) - static_cast<float>(row);
        const float right = static_cast<float>(positions[2 * i + 1]) - static_cast<float>(col);
        const float square = down * down + right * right;
        if (!(square < limit) || i == j || (loss > 0.0 && is_lost(key, i, j, loss))) return;
        edges.push_back({i, j, weights == Weights::binary ? 1.0f : 1.0f / std::sqrt(square)});
    };
    const double longest = std::max(layout.height, layout.width);
    const int reach = static_cast<int>(std::min(std::ceil(std::sqrt(static_cast<double>(limit))), longest));
    const double side = 2.0 * reach + 1.0;
    if (num_agents <= std::min<double>(side, layout.height) * std::min<double>(side, layout.width)) {
        for (int i = 0; i < num_agents; ++i)
            for (int j = 0; j < num_agents; ++j) add(i, j, positions[2 * j], positions[2 * j + 1]);
        return;
    }
    // In a row that is `down` rows away, robots hear up to spans[down] columns away.
    std::vector<int> spans(reach + 1);
    for (int down = 0; down <= reach; ++down) {
        const double left = static_cast<double>(limit) - static_cast<double>(down) * down;
        spans[down] = left > 0.0 ? static_cast<int>(std::min(std::ceil(std::sqrt(left)), longest)) : -1;
    }
    standing.resize(std::max<std::size_t>(standing.size(), layout.size()), -1);
    for (int i = 0; i < num_agents; ++i) standing[layout.cell(positions[2 * i], positions[2 * i + 1])] = i;
    const std::size_t before = edges.size();
    std::vector<std::size_t> begins(order ? num_agents : 0);
    std::vector<int> counts(begins.size());
    for (int k = 0; k < num_agents; ++k) {
        const int i = order ? order[k] : k;
        const std::size_t first = edges.size();
        const int row = positions[2 * i], col = positions[2 * i + 1];
        for (int r = std::max(row - reach, 0); r <= std::min(row + reach, layout.height - 1); ++r) {
            const int span = spans[std::abs(r - row)];
            const int* const there = standing.data() + layout.cell(r, 0);
            for (int c = std::max(col - span, 0); c <= std::min(col + span, layout.width - 1); ++c)
                if (const int j = there[c]; j >= 0) add(i, j, r, c);
        }
        std::sort(edges.begin() + static_cast<std::ptrdiff_t>(first), edges.end(),
                  [](const Edge& one, const Edge& other) { return one.sender < other.sender; });
        if (order == nullptr) continue;
        begins[i] = first;
        counts[i] = static_cast<int>(edges.size() - first);
    }
    if (order != nullptr) {  // bring them into the order of the receivers
        std::vector<Edge> sorted;
        sorted.reserve(edges.size());
        sorted.insert(sorted.end(), edges.begin(), edges.begin() + static_cast<std::ptrdiff_t>(before));
        for (int i = 0; i < num_agents; ++i) {
            const auto first = edges.begin() + static_cast<std::ptrdiff_t>(begins[i]);
            sorted.insert(sorted.end(), first, first + counts[i]);
        }
        edges = std::move(sorted);
    }
    for (int i = 0; i < num_agents; ++i) standing[layout.cell(positions[2 * i], positions[2 * i + 1])] = -1;
}

void lose_messages(int num_agents, double loss, std::uint64_t key, int stride, float* weights) {
    for (int i = 0; i < num_agents; ++i, weights += stride)
        for (int j = 0; j < num_agents; ++j)
            if (weights[j] != 0.0f && is_lost(key, i, j, loss)) weights[j] = 0.0f;
}

double connecting_radius(const std::int32_t* positions, int num_agents, double radius) {
    if (num_agents < 2) return radius;
    Box team;
    for (int i = 0; i < num_agents; ++i) team.add(positions + 2 * i);
    const double longest = length(team.bottom - team.top, team.right - team.left);  // of all links at most
    std::vector<double> radii{radius};
    while (!(longest < radii.back()))  // the smallest numbers times 1.1 are themselves
        radii.push_back(std::max(radii.back() * 1.1, std::nextafter(radii.back(), infinity)));
    return *std::partition_point(radii.begin(), radii.end() - 1, [&](double each) {
        return !is_connected(positions, num_agents, each);
    });
}

}  // namespace mapf
