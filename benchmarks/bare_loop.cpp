// The bare loop of speed.py: the least that any environment has to do, without Python, checks or choices. It moves robots
// that collide with nothing, and writes the bytes of their views (3 x 11 x 11) and of the communication graph; or it
// writes as many bytes and does nothing else ("stores"). Prints the agent-steps per CPU second of a thread, summed over
// threads that share nothing.
//   c++ -O3 -march=native -std=c++20 -pthread bare_loop.cpp -o bare_loop
//   ./bare_loop NUM_ENVS NUM_AGENTS SIZE DENSITY SECONDS uint8|float32 views|stores THREADS
#include <time.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <latch>
#include <random>
#include <string>
#include <thread>
#include <vector>

constexpr int radius = 4, window = 2 * radius + 1, side = window + 2, plane = side * side;

template <class T>
void copy_window(const T* from, int stride, T* out) {
    std::memset(out, 0, (side + 1) * sizeof(T));
    out += side + 1;
    for (int row = 0; row < window; ++row, from += stride, out += side) {
        std::memcpy(out, from, (window - 1) * sizeof(T));
        if constexpr (sizeof(T) == 1) {
            const std::uint32_t end = from[window - 1];
            std::memcpy(out + window - 1, &end, sizeof end);
        } else {
            out[window - 1] = from[window - 1];
            out[window] = out[window + 1] = T{0};
        }
    }
    std::memset(out, 0, (side - 1) * sizeof(T));
}

template <class T>
class Loop {
public:
    Loop(int num_envs, int num_agents, int size, double density)
        : envs_(num_envs), agents_(num_agents), stride_(size + 2 * radius), cells_(stride_ * stride_),
          maps_(static_cast<std::size_t>(num_envs) * cells_, T{1}), robots_(cells_, T{0}) {
        std::mt19937 random(0);
        for (int b = 0; b < num_envs; ++b)
            for (int row = 0; row < size; ++row)
                for (int col = 0; col < size; ++col)
                    maps_[static_cast<std::size_t>(b) * cells_ + (row + radius) * stride_ + col + radius] =
                        random() < density * 4294967295.0;
        const int total = num_envs * num_agents;
        rows_.resize(total), cols_.resize(total), goals_.resize(total), actions_.resize(64 * total);
        for (int i = 0; i < total; ++i) rows_[i] = random() % size, cols_[i] = random() % size;
        for (int& goal : goals_) goal = random() % plane;
        for (auto& action : actions_) action = random() % 5;
        views_.resize(static_cast<std::size_t>(total) * 3 * plane);
        graph_.resize(static_cast<std::size_t>(total) * num_agents);
    }

    void step(long time) {
        constexpr int down[] = {-1, 0, 1, 0, 0}, right[] = {0, -1, 0, 1, 0};
        const std::uint8_t* action = actions_.data() + time % 64 * envs_ * agents_;
        const T* map = maps_.data();
        int *rows = rows_.data(), *cols = cols_.data();
        const int* goals = goals_.data();
        T* out = views_.data();
        float* weights = graph_.data();
        for (int b = 0; b < envs_; ++b) {
            for (int i = 0; i < agents_; ++i) {
                const int row = rows[i] + down[action[i]], col = cols[i] + right[action[i]];
                const bool free = map[(row + radius) * stride_ + col + radius] == T{0};
                rows[i] = free ? row : rows[i];
                cols[i] = free ? col : cols[i];
                robots_[(rows[i] + radius) * stride_ + cols[i] + radius] = T{1};
            }
            for (int i = 0; i < agents_; ++i) {
                copy_window(map + rows[i] * stride_ + cols[i], stride_, out + i * 3 * plane);
                std::memset(out + (3 * i + 1) * plane, 0, plane * sizeof(T));
                out[(3 * i + 1) * plane + goals[i]] = T{1};
            }
            for (int i = 0; i < agents_; ++i)
                copy_window(robots_.data() + rows[i] * stride_ + cols[i], stride_, out + (3 * i + 2) * plane);
            for (int i = 0; i < agents_; ++i, weights += agents_)
                for (int j = 0; j < agents_; ++j) {
                    const int dr = rows[i] - rows[j], dc = cols[i] - cols[j];
                    weights[j] = dr * dr + dc * dc < 25 ? 1.0f : 0.0f;
                }
            for (int i = 0; i < agents_; ++i) robots_[(rows[i] + radius) * stride_ + cols[i] + radius] = T{0};
            action += agents_, rows += agents_, cols += agents_, goals += agents_;
            map += cells_, out += agents_ * 3 * plane;
        }
    }

    void store(long time) {
        std::memset(views_.data(), static_cast<int>(time), views_.size() * sizeof(T));
        std::memset(graph_.data(), static_cast<int>(time), graph_.size() * sizeof(float));
        asm volatile("" ::: "memory");
    }

private:
    int envs_, agents_, stride_, cells_;
    std::vector<T> maps_, robots_;
    std::vector<int> rows_, cols_, goals_;
    std::vector<std::uint8_t> actions_;
    std::vector<T> views_;
    std::vector<float> graph_;
};

double cpu_seconds() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

template <class T>
double agent_steps_per_second(int num_envs, int num_agents, int size, double density, double seconds, bool stores,
                              int threads) {
    std::vector<double> rates(threads);
    std::vector<std::thread> workers;
    std::latch ready(threads);
    for (double& rate : rates)
        workers.emplace_back([&] {
            Loop<T> loop(num_envs, num_agents, size, density);
            loop.step(0);
            ready.arrive_and_wait();
            const double began = cpu_seconds();
            double spent = 0;
            long steps = 0;
            for (; spent < seconds; spent = cpu_seconds() - began)
                for (int turn = 0; turn < 16; ++turn, ++steps) stores ? loop.store(steps) : loop.step(steps);
            rate = static_cast<double>(num_envs) * num_agents * steps / spent;
        });
    double sum = 0;
    for (int part = 0; part < threads; ++part) workers[part].join(), sum += rates[part];
    return sum;
}

int main(int count, char** arguments) {
    if (count != 9) return 2;
    const int num_envs = std::atoi(arguments[1]), num_agents = std::atoi(arguments[2]), size = std::atoi(arguments[3]);
    const double density = std::atof(arguments[4]), seconds = std::atof(arguments[5]);
    const bool stores = std::string(arguments[7]) == "stores";
    const auto measure = std::string(arguments[6]) == "uint8" ? agent_steps_per_second<std::uint8_t>
                                                            : agent_steps_per_second<float>;
    std::printf("%f\n", measure(num_envs, num_agents, size, density, seconds, stores, std::atoi(arguments[8])));
}
