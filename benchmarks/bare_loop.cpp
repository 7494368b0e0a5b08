// The bare loop of speed.py: the least that any environment has to do, without Python, checks or choices. It moves robots
// that collide with nothing, and writes the bytes of their views (3 x 11 x 11) and of the communication graph.
//   c++ -O3 -std=c++20 bare_loop.cpp -o bare_loop && ./bare_loop NUM_ENVS NUM_AGENTS SIZE DENSITY SECONDS uint8|float32
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <random>
#include <string>
#include <vector>

template <class T>
double agent_steps_per_second(int num_envs, int num_agents, int size, double density, double seconds) {
    constexpr int radius = 4, window = 2 * radius + 1, side = window + 2, plane = side * side;
    const int stride = size + 2 * radius, cells = stride * stride;
    std::mt19937 random(0);
    std::vector<T> maps(static_cast<std::size_t>(num_envs) * cells, T{1}), robots(cells, T{0});
    for (int b = 0; b < num_envs; ++b)
        for (int row = 0; row < size; ++row)
            for (int col = 0; col < size; ++col)
                maps[static_cast<std::size_t>(b) * cells + (row + radius) * stride + col + radius] =
                    random() < density * 4294967295.0;
    const int total = num_envs * num_agents;
    std::vector<int> rows(total), cols(total), goals(2 * total);
    for (int i = 0; i < total; ++i) rows[i] = random() % size, cols[i] = random() % size;
    for (int& goal : goals) goal = random() % size;
    std::vector<std::uint8_t> actions(64 * total);
    for (auto& action : actions) action = random() % 5;
    std::vector<T> views(static_cast<std::size_t>(total) * 3 * plane);
    std::vector<float> graph(static_cast<std::size_t>(total) * num_agents);
    constexpr int down[] = {-1, 0, 1, 0, 0}, right[] = {0, -1, 0, 1, 0};
    const auto began = std::clock();
    long steps = 0;
    double spent = 0;
    for (; spent < seconds; spent = static_cast<double>(std::clock() - began) / CLOCKS_PER_SEC, ++steps) {
        T* out = views.data();
        float* weights = graph.data();
        for (int b = 0; b < num_envs; ++b) {
            const T* map = maps.data() + static_cast<std::size_t>(b) * cells;
            const int first = b * num_agents;
            for (int i = first; i < first + num_agents; ++i) {
                const int action = actions[(steps % 64) * total + i];
                const int row = rows[i] + down[action], col = cols[i] + right[action];
                const bool free = map[(row + radius) * stride + col + radius] == T{0};
                rows[i] = free ? row : rows[i];
                cols[i] = free ? col : cols[i];
                robots[(rows[i] + radius) * stride + cols[i] + radius] = T{1};
            }
            for (int i = first; i < first + num_agents; ++i, out += 3 * plane) {
                const int corner = rows[i] * stride + cols[i];
                std::memset(out, 0, 3 * plane * sizeof(T));
                for (int r = 0; r < window; ++r) {
                    std::memcpy(out + (r + 1) * side + 1, map + corner + r * stride, window * sizeof(T));
                    std::memcpy(out + 2 * plane + (r + 1) * side + 1, robots.data() + corner + r * stride,
                                window * sizeof(T));
                }
                out[plane + goals[2 * i] % side * side + goals[2 * i + 1] % side] = T{1};
            }
            for (int i = first; i < first + num_agents; ++i, weights += num_agents)
                for (int j = 0; j < num_agents; ++j) {
                    const int dr = rows[i] - rows[first + j], dc = cols[i] - cols[first + j];
                    weights[j] = dr * dr + dc * dc < 25;
                }
            for (int i = first; i < first + num_agents; ++i)
                robots[(rows[i] + radius) * stride + cols[i] + radius] = T{0};
        }
    }
    return total * steps / spent;
}

int main(int count, char** values) {
    if (count != 7) return 2;
    const int num_envs = std::atoi(values[1]), num_agents = std::atoi(values[2]), size = std::atoi(values[3]);
    const double density = std::atof(values[4]), seconds = std::atof(values[5]);
    const auto measure = std::string(values[6]) == "uint8" ? agent_steps_per_second<std::uint8_t>
                                                            : agent_steps_per_second<float>;
    std::printf("%f\n", measure(num_envs, num_agents, size, density, seconds));
}
