// Steps to a goal from every cell, by breadth-first search.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <vector>

#include "mapf_env/native/grid.hpp"

namespace mapf {

using Distance = std::uint16_t;
inline constexpr Distance unreachable = std::numeric_limits<Distance>::max();

// The bits of a byte as the lowest bits of eight bytes, for each byte.
inline constexpr auto bits_as_bytes = [] {
    std::array<std::uint64_t, 256> table{};
    for (std::size_t byte = 0; byte < table.size(); ++byte)
        for (int bit = 0; bit < 8; ++bit) table[byte] |= static_cast<std::uint64_t>(byte >> bit & 1) << 8 * bit;
    return table;
}();

// Steps from every cell of a map of at most 64 * words cells to `goal`, on machines whose lowest byte comes first. A
// level of the breadth-first search is a few shifts of bits, and the distances are kept bit by bit until the end.
template <int words>
void distances_by_words(const Grid& grid, int goal, Distance* distance) {
    using Word = std::uint64_t;
    using Bits = std::array<Word, words>;  // one for each cell
    constexpr int word_bits = 64, margin = words / 2;  // a row and a word fit into the margin
    const int size = static_cast<int>(grid.blocked.size()), stride = grid.layout.stride();
    const int whole = stride / word_bits, part = stride % word_bits;
    std::array<std::uint8_t, word_bits * words> bytes;
    std::fill(std::copy(grid.blocked.begin(), grid.blocked.end(), bytes.begin()), bytes.end(), std::uint8_t{1});
    Bits unseen{}, next{};
    for (int eight = 0; eight < 8 * words; ++eight) {
        Word cells;
        std::memcpy(&cells, &bytes[8 * eight], sizeof cells);
        unseen[eight / 8] |= (~cells & bits_as_bytes[255]) * 0x0102040810204080 >> 56 << 8 * (eight % 8);
    }
    const auto open = unseen;
    std::array<Word, words + 2 * margin> level{};
    std::array<Bits, std::bit_width(64u * words)> distance_bits{};
    next[goal / word_bits] = Word{1} << goal % word_bits;
    int steps = 0;
    for (Word any = 1; any != 0; ++steps) {
        for (int word = 0; word < words; ++word) unseen[word] &= ~next[word];
        std::copy(next.begin(), next.end(), level.begin() + margin);
        for (int bit = 0; steps >> bit; ++bit)
            if (steps >> bit & 1)
                for (int word = 0; word < words; ++word) distance_bits[bit][word] |= next[word];
        any = 0;
        for (int word = 0; word < words; ++word) {
            const Word* const here = level.data() + margin + word;
            const Word sideways = here[0] << 1 | here[-1] >> (word_bits - 1) | here[0] >> 1 | here[1] << (word_bits - 1);
            const Word below = here[-whole] << part | here[-whole - 1] >> 1 >> (word_bits - 1 - part);
            const Word above = here[whole] >> part | here[whole + 1] << 1 << (word_bits - 1 - part);
            next[word] = (sideways | below | above) & unseen[word];
            any |= next[word];
        }
    }
    std::array<Word, 8 * words> low{}, high{};  // bytes of the distances
    const auto add = [](const Bits& bits, int factor, std::array<Word, 8 * words>& sum) {
        std::array<std::uint8_t, sizeof bits> eights;
        std::memcpy(eights.data(), bits.data(), sizeof bits);
        for (int eight = 0; eight < 8 * words; ++eight) sum[eight] += bits_as_bytes[eights[eight]] * factor;
    };
    for (int bit = 0; steps >> bit; ++bit) add(distance_bits[bit], 1 << bit % 8, bit < 8 ? low : high);
    for (int word = 0; word < words; ++word) unseen[word] |= ~open[word];
    add(unseen, 255, low);
    add(unseen, 255, high);
    std::array<std::uint8_t, sizeof low> low_bytes, high_bytes;
    std::memcpy(low_bytes.data(), low.data(), sizeof low);
    std::memcpy(high_bytes.data(), high.data(), sizeof high);
    for (int cell = 0; cell < size; ++cell) distance[cell] = static_cast<Distance>(low_bytes[cell] | high_bytes[cell] << 8);
}

// Appends the neighbours of a cell that have no distance yet to the queue `open` of `tail` cells; returns its new length.
// Obstacles have any other distance than `unreachable`, so that one comparison without a branch tells what is new. Throws
// std::invalid_argument if a distance does not fit.
inline std::size_t expand_cell(Distance* found, int* open, std::size_t tail, int cell,
                               const std::array<int, num_actions>& steps) {
    const auto next = static_cast<Distance>(found[cell] + 1);
    if (next == unreachable) throw std::invalid_argument("a shortest path on this map is longer than 65533 steps");
    for (int action = 0; action < idle; ++action) {
        const int neighbour = cell + steps[action];
        const bool is_new = found[neighbour] == unreachable;
        found[neighbour] = is_new ? next : found[neighbour];
        open[tail] = neighbour;
        tail += is_new;
    }
    return tail;
}

// Steps from every cell to `goal` by breadth-first search, `unreachable` where there is no way. `queue` is scratch.
// Throws std::invalid_argument if a distance does not fit.
inline void distances_to(const Grid& grid, int goal, std::vector<Distance>& distance, std::vector<int>& queue) {
    const std::size_t size = grid.blocked.size();
    distance.resize(size);
    if constexpr (std::endian::native == std::endian::little) {  // twice as fast on 20x20 and 32x32
        if (size <= 64 * 8) return distances_by_words<8>(grid, goal, distance.data());
        if (size <= 64 * 20) return distances_by_words<20>(grid, goal, distance.data());
    }
    queue.resize(size);
    // Obstacles count as visited until the end.
    for (std::size_t cell = 0; cell < size; ++cell) distance[cell] = grid.blocked[cell] ? 0 : unreachable;
    const auto steps = grid.layout.steps();
    Distance* const found = distance.data();
    int* const open = queue.data();
    std::size_t head = 0, tail = 0;
    found[goal] = 0;
    open[tail++] = goal;
    while (head < tail) tail = expand_cell(found, open, tail, open[head++], steps);
    for (std::size_t cell = 0; cell < size; ++cell) distance[cell] = grid.blocked[cell] ? unreachable : distance[cell];
}

}  // namespace mapf
