// A hash table over (cell, time) that is cleared in constant time: the searches' only associative memory.
#pragma once

#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace mapf {

// Open addressing; a slot counts only if it carries the stamp of the current use. References die on the next insertion.
template <class Value>
class PairTable {
public:
    PairTable() { resize(initial_bits); }

    void clear() {
        used_ = 0;
        if (++stamp_ != 0) return;
        for (auto& slot : slots_) slot.stamp = 0;
        stamp_ = 1;
    }

    std::size_t size() const { return used_; }

    // The value stored there, or a default one.
    const Value& at(int cell, int time) const {
        const Slot& slot = slots_[probe(key(cell, time))];
        return slot.stamp == stamp_ ? slot.value : none_;
    }

    // The value stored there, which is stored now if there was none.
    Value& operator()(int cell, int time) {
        const auto wanted = key(cell, time);
        std::size_t place = probe(wanted);
        if (slots_[place].stamp == stamp_) return slots_[place].value;
        if (2 * ++used_ > slots_.size()) {
            grow();
            place = probe(wanted);
        }
        slots_[place] = Slot{wanted, stamp_, Value{}};
        return slots_[place].value;
    }

private:
    struct Slot {
        std::uint64_t key = 0;
        std::uint32_t stamp = 0;
        Value value{};
    };

    static constexpr int initial_bits = 9;

    static std::uint64_t key(int cell, int time) {
        return static_cast<std::uint64_t>(static_cast<std::uint32_t>(time)) << 32 | static_cast<std::uint32_t>(cell);
    }

    std::size_t probe(std::uint64_t wanted) const {
        const std::size_t mask = slots_.size() - 1;
        std::size_t place = (wanted * 0x9E3779B97F4A7C15ull) >> shift_;
        while (slots_[place].stamp == stamp_ && slots_[place].key != wanted) place = (place + 1) & mask;
        return place;
    }

    void resize(int bits) {
        slots_.assign(std::size_t{1} << bits, Slot{});
        shift_ = 64 - bits;
    }

    void grow() {
        const auto old = std::move(slots_);
        resize(64 - shift_ + 1);
        for (const auto& slot : old)
            if (slot.stamp == stamp_) slots_[probe(slot.key)] = slot;
    }

    std::vector<Slot> slots_;
    std::size_t used_ = 0;
    std::uint32_t stamp_ = 1;
    int shift_ = 0;
    Value none_{};
};

}  // namespace mapf
