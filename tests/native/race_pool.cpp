// Rounds of work over threads, to be run with ThreadSanitizer:
//   c++ -std=c++20 -g -O1 -fsanitize=thread -I. -pthread tests/native/race_pool.cpp -o race_pool && ./race_pool
// Every item of a round is done exactly once, and an exception comes back to the caller without spoiling the next round.
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <vector>

#include "mapf_env/native/pool.hpp"

namespace {

void require(bool holds, const char* what) {
    if (holds) return;
    std::printf("%s\n", what);
    std::exit(1);
}

}  // namespace

int main() {
    for (const int threads : {1, 2, 3, 5})
        for (int pools = 0; pools < 20; ++pools) {
            mapf::Pool pool(threads);
            for (int round = 0; round < 300; ++round) {
                std::vector<int> done(round % 37, 0);
                pool.for_each(done.size(), [&](std::size_t i, int part) {
                    require(part >= 0 && part < threads, "there is no such part");
                    ++done[i];
                });
                for (const int times : done) require(times == 1, "an item was not done exactly once");
                if (round % 50 != 7) continue;
                bool thrown = false;
                try {
                    pool.for_each(9, [](std::size_t i, int) {
                        if (i == 4) throw std::runtime_error("item 4");
                    });
                } catch (const std::runtime_error&) {
                    thrown = true;
                }
                require(thrown, "an exception was lost");
            }
        }
    std::puts("all rounds were whole");
}
