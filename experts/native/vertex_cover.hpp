// The fewest vertices that touch all edges of a small graph: how many robots at least must take longer.
#pragma once

#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace mapf {

// The minimum vertex cover by branch and bound; on graphs of more than 64 vertices that have edges a lower bound of it.
class VertexCover {
public:
    using Edge = std::pair<int, int>;

    int size(const std::vector<Edge>& edges) {
        names_.clear();
        for (const auto& [a, b] : edges) names_.insert(names_.end(), {a, b});
        std::sort(names_.begin(), names_.end());
        names_.erase(std::unique(names_.begin(), names_.end()), names_.end());
        if (names_.size() > 64) return matching(edges);
        adjacent_.assign(names_.size(), 0);
        for (const auto& [a, b] : edges) {
            const int i = name(a), j = name(b);
            adjacent_[i] |= std::uint64_t{1} << j;
            adjacent_[j] |= std::uint64_t{1} << i;
        }
        const auto all = names_.size() == 64 ? ~std::uint64_t{0} : (std::uint64_t{1} << names_.size()) - 1;
        steps_ = 0;
        return cover(all, static_cast<int>(names_.size()));
    }

private:
    static constexpr int most_steps = 2'000;

    int name(int vertex) const {
        return static_cast<int>(std::lower_bound(names_.begin(), names_.end(), vertex) - names_.begin());
    }

    // The cover of the vertices in `left` if it is smaller than `bound`, else `bound`. A lower bound out of steps.
    int cover(std::uint64_t left, int bound) {
        if (bound <= 0) return bound;
        int busiest = -1, degree = 0;
        for (auto rest = left; rest != 0; rest &= rest - 1) {
            const int vertex = std::countr_zero(rest);
            const int own = std::popcount(adjacent_[vertex] & left);
            if (own > degree) busiest = vertex, degree = own;
        }
        if (degree == 0) return 0;
        if (degree == 1) {  // the edges that are left touch nowhere
            int ends = 0;
            for (auto rest = left; rest != 0; rest &= rest - 1)
                ends += (adjacent_[std::countr_zero(rest)] & left) != 0;
            return std::min(bound, ends / 2);
        }
        if (++steps_ > most_steps) return 1;
        const auto without = left & ~(std::uint64_t{1} << busiest);
        bound = std::min(bound, 1 + cover(without, bound - 1));
        const int neighbours = std::popcount(adjacent_[busiest] & left);
        if (neighbours < bound)
            bound = std::min(bound, neighbours + cover(without & ~adjacent_[busiest], bound - neighbours));
        return bound;
    }

    static int matching(const std::vector<Edge>& edges) {
        std::vector<int> used;
        int pairs = 0;
        for (const auto& [a, b] : edges) {
            if (std::find(used.begin(), used.end(), a) != used.end()) continue;
            if (std::find(used.begin(), used.end(), b) != used.end()) continue;
            used.insert(used.end(), {a, b});
            ++pairs;
        }
        return pairs;
    }

    std::vector<int> names_;
    std::vector<std::uint64_t> adjacent_;
    int steps_ = 0;
};

}  // namespace mapf
