// Seeded randomness that is the same on every platform: SplitMix64 (Steele, Lea and Flood, 2014).
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

namespace mapf {

// A well-mixed 64-bit hash of a seed and a counter: the seed's `counter`-th draw.
inline std::uint64_t mix(std::uint64_t seed, std::uint64_t counter) {
    std::uint64_t z = seed + (counter + 1) * 0x9e3779b97f4a7c15ull;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ull;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebull;
    return z ^ (z >> 31);
}

// The uses of a seed. Each use has its own random stream: robots' starts must not depend on the obstacles of the same
// seed.
enum class Use : std::uint64_t { map, placement, ties, priorities, preferences, messages, goals };

inline std::uint64_t seed_for(Use use, std::uint64_t seed) { return mix(seed, static_cast<std::uint64_t>(use)); }

// 53 bits of a hash as a number in [0, 1).
inline double uniform(std::uint64_t hash) { return static_cast<double>(hash >> 11) * 0x1p-53; }

class Random {
public:
    explicit Random(std::uint64_t seed) : seed_(mix(seed, 0)) {}

    // Uniform over 0..bound-1, without bias (Lemire, 2019).
    int below(int bound) {
        const auto n = static_cast<std::uint32_t>(bound);
        const std::uint32_t threshold = (0u - n) % n;
        while (true) {
            const std::uint64_t product = (mix(seed_, counter_++) >> 32) * n;
            if (static_cast<std::uint32_t>(product) >= threshold) return static_cast<int>(product >> 32);
        }
    }

    // Brings a uniform sample of `count` items to the front of `items`, in random order.
    template <class T>
    void shuffle_front(std::vector<T>& items, int count) {
        for (int i = 0; i < count; ++i) std::swap(items[i], items[i + below(static_cast<int>(items.size()) - i)]);
    }

private:
    std::uint64_t seed_;
    std::uint64_t counter_ = 0;
};

}  // namespace mapf
