#include "mapf_env/native/graph.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
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
    const auto add = [&](int i, int j) {
        const float down = static_cast<float>(positions[2 * i]) - static_cast<float>(positions[2 * j]);
        const float right = static_cast<float>(positions[2 * i + 1]) - static_cast<float>(positions[2 * j + 1]);
        const float square = down * down + right * right;
        if (!(square < limit) || i == j || (loss > 0.0 && is_lost(key, i, j, loss))) return;
        edges.push_back({i, j, weights == Weights::binary ? 1.0f : 1.0f / std::sqrt(square)});
    };
    const double longest = std::max(layout.height, layout.width);
    const int reach = static_cast<int>(std::min(std::ceil(std::sqrt(static_cast<double>(limit))), longest));
    const double side = 2.0 * reach + 1.0;
    if (num_agents <= std::min<double>(side, layout.height) * std::min<double>(side, layout.width)) {
        for (int i = 0; i < num_agents; ++i)
            for (int j = 0; j < num_agents; ++j) add(i, j);
        return;
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
        const int left = std::max(col - reach, 0), right = std::min(col + reach, layout.width - 1);
        for (int r = std::max(row - reach, 0); r <= std::min(row + reach, layout.height - 1); ++r)
            for (int c = left; c <= right; ++c)
                if (const int j = standing[layout.cell(r, c)]; j >= 0) add(i, j);
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
    // The longest edge of the shortest spanning tree (Prim 1957) is what the radius has to exceed.
    std::vector<double> gap(num_agents, std::numeric_limits<double>::infinity());
    std::vector<bool> joined(num_agents, false);
    double longest = 0.0;
    int newest = 0;
    for (int size = 1; size < num_agents; ++size) {
        joined[newest] = true;
        int closest = -1;
        for (int i = 0; i < num_agents; ++i) {
            if (joined[i]) continue;
            const double down = positions[2 * i] - positions[2 * newest];
            const double right = positions[2 * i + 1] - positions[2 * newest + 1];
            gap[i] = std::min(gap[i], down * down + right * right);
            if (closest < 0 || gap[i] < gap[closest]) closest = i;
        }
        longest = std::max(longest, gap[closest]);
        newest = closest;
    }
    const double infinity = std::numeric_limits<double>::infinity();
    while (num_agents > 1 && !(std::sqrt(longest) < radius))
        radius = std::max(radius * 1.1, std::nextafter(radius, infinity));  // the smallest numbers times 1.1 are themselves
    return radius;
}

}  // namespace mapf
