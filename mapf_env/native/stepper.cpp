#include "mapf_env/native/stepper.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#ifndef _WIN32
#include <unistd.h>
#endif

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "mapf_env/native/arrays.hpp"
#include "mapf_env/native/bag.hpp"
#include "mapf_env/native/by_agent.hpp"
#include "mapf_env/native/checks.hpp"
#include "mapf_env/native/perceive.hpp"
#include "mapf_env/native/pool.hpp"
#include "mapf_env/native/team_step.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace mapf {

namespace {

int process() {
#ifdef _WIN32
    return 0;
#else
    return static_cast<int>(getpid());
#endif
}

// Output arrays for observations: those of a `mapf_env.Observation`; those without columns are not read.
template <class T>
struct Room {
    InOut<T, 5> fov;            // (B, N, C, side, side)
    InOut<float, 3> graph;      // (B, N, N)
    InOut<float, 3> scalars;    // (B, N, K)
    InOut<float, 4> edge_attr;  // (B, N, N, D)
};

// Output arrays for the observations of a batch of one team and its action masks (N, 5).
template <class T>
struct AgentBuffers {
    Room<T> room;
    InOut<std::int8_t, 2> masks;
};

float part(nb::handle rewards, const char* name) { return nb::cast<float>(rewards.attr(name)); }

Options options_of(nb::handle config) {
    const auto says = [&](const char* field, const char* word) {
        return nb::cast<std::string>(config.attr(field)) == word;
    };
    const nb::object rewards = config.attr("rewards");
    Options options;
    options.senses = senses_of(config);
    options.pibt = !says("shield", "idle");
    options.swap = says("shield", "pibt_swap");
    options.lifelong = says("task", "lifelong");
    options.message_loss = nb::cast<double>(config.attr("message_loss"));
    options.comm_radius = nb::cast<double>(config.attr("comm_radius"));
    options.connected = says("comm_range", "connected");
    options.rewards.on_goal = part(rewards, "on_goal");
    options.rewards.off_goal = part(rewards, "off_goal");
    options.rewards.arrival = part(rewards, "arrival");
    options.rewards.replaced = part(rewards, "replaced");
    options.rewards.solved = part(rewards, "solved");
    options.rewards.closer = part(rewards, "closer");
    return options;
}

// The rules bound to the arrays of B teams, which Python owns and this changes in place.
template <class T>
class Stepper {
public:
    Stepper(nb::object state, nb::handle config, int threads)
        : state_(std::move(state)), options_(options_of(config)), threads_(threads) {
        const int border = options_.senses.fov_radius;
        const auto positions = array<std::int32_t, 3>("positions");
        const auto obstacles = array<T, 3>("obstacles");
        const std::size_t B = positions.shape(0), N = positions.shape(1);
        const int rows = static_cast<int>(obstacles.shape(1)), cols = static_cast<int>(obstacles.shape(2));
        teams_.layout = {rows - 2 * border, cols - 2 * border, border};
        teams_.num_envs = B;
        teams_.num_agents = N;
        const std::size_t size = teams_.layout.size();
        if (border < 1 || rows <= 2 * border || cols <= 2 * border || threads < 1)
            fail("the arrays of the teams do not fit together");
        teams_.obstacles = own<T>("obstacles", {B, rows * 1u, cols * 1u});
        teams_.positions = own<std::int32_t>("positions", {B, N, 2});
        teams_.goals = own<std::int32_t>("goals", {B, N, 2});
        teams_.moves = own<std::int8_t>("moves", {B, N, history});
        teams_.team_sizes = own<std::int32_t>("team_sizes", {B});
        teams_.grids = own<bool>("grids", {B, teams_.layout.height * 1u, teams_.layout.width * 1u});
        teams_.started = own<bool>("started", {B});
        teams_.seeds = own<std::uint64_t>("seeds", {B});
        teams_.comm_radius = own<double>("comm_radius", {B});
        teams_.regions = own<std::int32_t>("regions", {B, size}, !options_.lifelong);
        teams_.under_way = own<std::int32_t>("under_way", {B, N});
        teams_.arrivals = own<std::int32_t>("arrivals", {B, N});
        teams_.times = own<std::int64_t>("times", {B});
        teams_.max_cycles = own<std::int32_t>("max_cycles", {B});
        teams_.ended = own<bool>("ended", {B});
        teams_.rewards = own<float>("rewards", {B, N});
        teams_.terminated = own<bool>("terminated", {B});
        teams_.truncated = own<bool>("truncated", {B});
        teams_.replaced = own<bool>("replaced", {B, N});
        teams_.arrived = own<bool>("arrived", {B, N});
        teams_.on_goal = own<bool>("on_goal", {B, N});
        teams_.action_mask = own<std::int8_t>("action_mask", {B, N, num_actions});
        const bool distances = options_.swap || options_.senses.needs_map || options_.rewards.closer != 0.0f;
        const auto tables = array<Distance, 4>("distances");
        teams_.table = {static_cast<int>(tables.shape(2)), static_cast<int>(tables.shape(3))};
        const int least = 2 * border + 1;
        if (distances && (teams_.table.rows < least || teams_.table.cols < least || teams_.table.rows > rows ||
                          teams_.table.cols > cols))
            fail("distances must have shape (B, N, rows, cols), as far as robots see and no larger than the map");
        teams_.distances = own<Distance>("distances", {B, N, tables.shape(2), tables.shape(3)}, !distances);
        teams_.corners = own<std::int32_t>("corners", {B, N, 2});
        require_corners();
        const std::size_t parts = std::min<std::size_t>(threads, B);
        for (std::size_t part = 0; part < parts; ++part) scratch_.emplace_back(teams_.layout, static_cast<int>(N));
    }

    // Steps and, unless `out` is None, writes what the teams perceive.
    void step(In<std::int64_t, 2> actions, nb::handle out, bool skip_ended) {
        const std::size_t B = teams_.num_envs, N = teams_.num_agents;
        if (actions.shape(0) != B || actions.shape(1) != N)
            fail("actions must have shape " + shown({B, N}) + ", got " + shown({actions.shape(0), actions.shape(1)}));
        require_actions(actions.data(), B, N);
        run({actions.data(), nullptr}, out, skip_ended);
    }

    void step_by_scores(In<float, 3> scores, nb::handle out, bool skip_ended) {
        const std::size_t B = teams_.num_envs, N = teams_.num_agents;
        if (!options_.pibt)
            fail("actions must have shape " + shown({B, N}) +
                 "; scores of all five actions need a shield other than \"idle\"");
        if (scores.shape(0) != B || scores.shape(1) != N || scores.shape(2) != num_actions)
            fail("scores of actions must have shape " + shown({B, N, num_actions}) + ", got " +
                 shown({scores.shape(0), scores.shape(1), scores.shape(2)}));
        for (std::size_t i = 0; i < scores.size(); ++i)
            if (std::isnan(scores.data()[i]))
                fail("a value of agent " + std::to_string(i / num_actions % N) + " in environment " +
                     std::to_string(i / num_actions / N) + " is not a number");
        run({nullptr, scores.data()}, out, skip_ended);
    }

    // Writes what the teams perceive; with `chosen` (B) those teams only.
    void observe(nb::handle out, std::optional<In<bool, 1>> chosen) {
        const Room<T> room = room_of(out);
        const Percepts<T> percepts = percepts_of(room);
        const bool* wanted = wanted_teams(chosen);
        nb::gil_scoped_release release;
        for_each_team([&](std::size_t b, TeamScratch<T>& scratch) {
            if (wanted == nullptr || wanted[b]) perceive_into(b, scratch, percepts);
        });
    }

    // The bag of the teams that are under way; with `chosen` (B) of those among them.
    nb::tuple bag(std::optional<In<bool, 1>> chosen) {
        const bool* wanted = wanted_teams(chosen);
        std::vector<std::size_t> teams;
        for (std::size_t b = 0; b < teams_.num_envs; ++b)
            if (teams_.started[b] && !teams_.ended[b] && (wanted == nullptr || wanted[b])) teams.push_back(b);
        const std::size_t size = teams_.layout.size();
        const auto team_of = [&](std::size_t t, int part, bool needs_map) -> BagTeam<T> {
            auto& scratch = scratch_[part];
            return {facts_of(teams_, teams[t], needs_map, scratch), teams_.obstacles + teams[t] * size,
                    scratch.marks.data(), scratch.standing};
        };
        return make_bag<T>(
            options_.senses, options_.message_loss, teams.size(),
            [&](std::size_t t) { return static_cast<std::size_t>(teams_.team_sizes[teams[t]]); }, team_of,
            [&](std::size_t t) { return teams[t]; },
            [&](std::size_t t) { return message_key(teams_.seeds[teams[t]], teams_.times[teams[t]]); },
            [&](std::size_t count, const auto& job) { for_each(count, job); });
    }

    AgentBuffers<T> agent_buffers(nb::handle out, InOut<std::int8_t, 2> masks) const { return {room_of(out), std::move(masks)}; }

    // Fills dictionaries by agent with the outcome of the last step of a batch of one team, and its action masks. Returns
    // true if the episode has ended.
    bool outcome_by_agent(const AgentBuffers<T>& buffers, nb::list agents, nb::dict rewards, nb::dict terminated,
                          nb::dict truncated, nb::dict infos) {
        const std::size_t N = teams_.num_agents;
        if (teams_.num_envs != 1 || agents.size() != N) fail("give one name for each agent of one team");
        require_masks(buffers);
        write_action_mask(teams_, 0);
        std::copy_n(teams_.action_mask, N * num_actions, buffers.masks.data());
        const std::array flags{teams_.replaced, teams_.on_goal, teams_.arrived};
        const std::size_t num_flags = options_.lifelong ? 3 : 2;
        PyObject* const ended[2] = {teams_.terminated[0] ? Py_True : Py_False, teams_.truncated[0] ? Py_True : Py_False};
        nb::object reward;
        for (std::size_t i = 0; i < N; ++i) {
            PyObject* agent = PyList_GetItem(agents.ptr(), static_cast<Py_ssize_t>(i));
            if (i == 0 || teams_.rewards[i] != teams_.rewards[i - 1])
                reward = nb::steal(PyFloat_FromDouble(teams_.rewards[i]));
            set(rewards.ptr(), agent, reward.ptr());
            set(terminated.ptr(), agent, ended[0]);
            set(truncated.ptr(), agent, ended[1]);
            PyObject* info = PyDict_GetItem(infos.ptr(), agent);
            if (info == nullptr || !PyDict_Check(info)) fail("infos must have a dictionary for each agent");
            for (std::size_t k = 0; k < num_flags; ++k) set(info, info_names_[k].ptr(), flags[k][i] ? Py_True : Py_False);
        }
        return teams_.ended[0];
    }

    // `step` and `outcome_by_agent` of the only team; None, and nothing done, if the actions cannot be read.
    std::optional<bool> step_agents(nb::dict actions, const AgentBuffers<T>& buffers, nb::list agents, nb::dict rewards,
                                    nb::dict terminated, nb::dict truncated, nb::dict infos) {
        wanted_.resize(teams_.num_agents);
        if (teams_.num_envs != 1 || !read_actions(actions, agents, wanted_)) return std::nullopt;
        require_actions(wanted_.data(), 1, wanted_.size());
        require_masks(buffers);
        const Percepts<T> percepts = percepts_of(buffers.room);
        run({wanted_.data(), nullptr}, &percepts, false);
        return outcome_by_agent(buffers, agents, rewards, terminated, truncated, infos);
    }

    // Begins episodes of M chosen teams on the given instances; nothing is changed if one of them cannot begin.
    void begin(In<std::int64_t, 1> chosen, In<std::uint64_t, 1> seeds, In<std::int32_t, 1> limits, In<bool, 3> grids,
               In<std::int32_t, 3> starts, In<std::int32_t, 3> goals, In<std::int32_t, 1> sizes) {
        const auto& layout = teams_.layout;
        const std::size_t M = chosen.shape(0), N = teams_.num_agents, height = layout.height, width = layout.width;
        if (grids.shape(0) != M || grids.shape(1) != height || grids.shape(2) != width)
            fail("grids must have shape " + shown({M, height, width}));
        if (starts.shape(0) != M || starts.shape(1) != N || starts.shape(2) != 2 || goals.shape(0) != M ||
            goals.shape(1) != N || goals.shape(2) != 2)
            fail("starts and goals must have shape " + shown({M, N, 2}));
        if (seeds.shape(0) != M || sizes.shape(0) != M || limits.shape(0) != M)
            fail("give one seed, limit and size for each team");
        for (std::size_t k = 0; k < M; ++k) {
            if (static_cast<std::uint64_t>(chosen(k)) >= teams_.num_envs) fail("there is no such environment");
            if (limits(k) < 1) fail("max_cycles must be at least 1");
            if (static_cast<std::uint32_t>(sizes(k)) > N) fail("a team is larger than the environment's");
            for (std::size_t i = 2 * N * k; i < 2 * (N * k + sizes(k)); i += 2)
                for (const std::int32_t* cell : {starts.data() + i, goals.data() + i})
                    if (!layout.contains(cell[0], cell[1])) fail("a start or goal lies outside the map");
        }
        std::vector<EpisodeStart> episodes;
        nb::gil_scoped_release release;
        episodes.reserve(M);
        for (std::size_t k = 0; k < M; ++k)
            episodes.push_back(
                prepare_episode(teams_, reinterpret_cast<const std::uint8_t*>(grids.data()) + k * height * width,
                                    starts.data() + 2 * N * k, goals.data() + 2 * N * k, sizes(k)));
        for (std::size_t k = 0; k < M; ++k) begin_team(teams_, options_, chosen(k), seeds(k), limits(k), episodes[k]);
    }

    // The tables (K, rows, cols) and corners (K, 2) of K robots of team b with other goals, and whether they can reach
    // them from where they stand. The arrays have no rows where the team has no tables.
    nb::tuple ways_to(std::size_t b, In<std::int64_t, 1> robots, In<std::int32_t, 2> goals) {
        const auto& layout = teams_.layout;
        const std::size_t K = robots.shape(0);
        require(b < teams_.num_envs && goals.shape(0) == K && goals.shape(1) == 2, "give a goal for each robot of a team");
        for (std::size_t k = 0; k < K; ++k)
            require(static_cast<std::uint64_t>(robots(k)) < teams_.num_agents && layout.contains(goals(k, 0), goals(k, 1)),
                    "a robot or goal does not exist");
        const bool keeps = teams_.distances != nullptr;
        const TableShape shape = keeps ? teams_.table : TableShape{1, 1};
        auto [tables, out_tables] = make_array<Distance>({K, shape.rows * 1u, shape.cols * 1u});
        auto [corners, out_corners] = make_array<std::int32_t>({K, 2});
        auto [reached, out_reached] = make_array<bool>({K});
        {
            nb::gil_scoped_release release;
            auto& search = scratch_[0].search;
            search.on(layout, teams_.obstacles + b * layout.size());
            for (std::size_t k = 0; k < K; ++k) {
                const std::int32_t* here = teams_.positions + 2 * (b * teams_.num_agents + robots(k));
                Distance* const table = tables + k * shape.size();
                search.fill(layout.cell(goals(k, 0), goals(k, 1)), here[0], here[1], shape, corners + 2 * k, table);
                const WayTables ways{table, corners + 2 * k, shape};
                reached[k] = *ways.at(layout, 0, here[0], here[1]) != unreachable;
            }
        }
        return nb::make_tuple(out_tables, out_corners, out_reached);
    }

    void write_action_masks() {
        for (std::size_t b = 0; b < teams_.num_envs; ++b) write_action_mask(teams_, b);
    }

private:
    template <class Value, int dims>
    InOut<Value, dims> array(const char* name) {
        return nb::cast<InOut<Value, dims>>(state_.attr(name), false);
    }

    // The data of an array of the state, whose shape is checked; nullptr if it may be missing and is empty.
    template <class Value>
    Value* own(const char* name, std::initializer_list<std::size_t> shape, bool may_miss = false) {
        auto held = nb::cast<nb::ndarray<Value, nb::c_contig, nb::device::cpu>>(state_.attr(name), false);
        if (may_miss && held.size() == 0) return nullptr;
        bool fits = held.ndim() == shape.size();
        for (std::size_t axis = 0; fits && axis < shape.size(); ++axis)
            fits = held.shape(axis) == shape.begin()[axis];
        if (!fits) fail(std::string(name) + " must have shape " + shown(shape));
        return held.data();
    }

    // Tables that were changed from outside must still lie on the map.
    void require_corners() const {
        if (teams_.distances == nullptr) return;
        const auto& layout = teams_.layout;
        for (std::size_t i = 0; i < 2 * teams_.num_envs * teams_.num_agents; i += 2)
            if (teams_.corners[i] < 0 || teams_.corners[i] > layout.rows() - teams_.table.rows ||
                teams_.corners[i + 1] < 0 || teams_.corners[i + 1] > layout.stride() - teams_.table.cols)
                fail("a table of distances lies outside the map");
    }

    // Reads the arrays of an observation.
    Room<T> room_of(nb::handle out) const {
        Room<T> room;
        const bool sound = PyTuple_Check(out.ptr()) && PyTuple_Size(out.ptr()) == 4;
        const auto part = [&](Py_ssize_t i) { return nb::handle(PyTuple_GetItem(out.ptr(), i)); };
        if (!sound || !nb::try_cast(part(0), room.fov, false) || !nb::try_cast(part(1), room.graph, false) ||
            (options_.senses.robot_columns > 0 && !nb::try_cast(part(2), room.scalars, false)) ||
            (options_.senses.edge_columns > 0 && !nb::try_cast(part(3), room.edge_attr, false)))
            throw nb::type_error(
                (std::string("out must be an Observation of contiguous arrays as buffers() makes it: ") +
                 (sizeof(T) == 1 ? "uint8" : "float32") + " for the views and float32 for the rest")
                    .c_str());
        return room;
    }

    // The buffers of a room whose shapes are right.
    Percepts<T> percepts_of(const Room<T>& room) const {
        const auto& senses = options_.senses;
        const std::size_t B = teams_.num_envs, N = teams_.num_agents, side = senses.side();
        const std::size_t C = senses.num_planes, K = senses.robot_columns, D = senses.edge_columns;
        const auto fits = [](const auto& array, std::initializer_list<std::size_t> shape, const char* what) {
            for (std::size_t axis = 0; axis < shape.size(); ++axis)
                if (array.shape(axis) != shape.begin()[axis])
                    fail(std::string("the buffer for ") + what + " must have shape " + shown(shape));
        };
        fits(room.fov, {B, N, C, side, side}, "views");
        fits(room.graph, {B, N, N}, "graphs");
        Percepts<T> percepts{room.fov.data(), room.graph.data(), nullptr, nullptr};
        if (K > 0) {
            fits(room.scalars, {B, N, K}, "scalars");
            percepts.scalars = room.scalars.data();
        }
        if (D > 0) {
            fits(room.edge_attr, {B, N, N, D}, "edge_attr");
            percepts.edge_attr = room.edge_attr.data();
        }
        return percepts;
    }

    const bool* wanted_teams(const std::optional<In<bool, 1>>& chosen) const {
        if (chosen && chosen->shape(0) != teams_.num_envs) fail("give one choice for each environment");
        return chosen ? chosen->data() : nullptr;
    }

    void require_masks(const AgentBuffers<T>& buffers) const {
        if (buffers.masks.shape(0) != teams_.num_agents || buffers.masks.shape(1) != num_actions)
            fail("the buffer for masks must have shape " + shown({teams_.num_agents, num_actions}));
    }

    void perceive_into(std::size_t b, TeamScratch<T>& scratch, const Percepts<T>& all) {
        const std::size_t N = teams_.num_agents, robots = b * N;
        const auto& senses = options_.senses;
        perceive(teams_, options_, b, scratch,
                 Percepts<T>{all.fov + robots * senses.view(), all.graph + robots * N,
                             all.scalars + robots * senses.robot_columns,
                             all.edge_attr + robots * N * senses.edge_columns});
    }

    // Calls job(i, part) for every i in 0..count-1, over the threads.
    template <class Job>
    void for_each(std::size_t count, Job&& job) {
        const std::size_t parts = std::min<std::size_t>(threads_, teams_.num_envs);
        if (parts == 1) {
            for (std::size_t i = 0; i < count; ++i) job(i, 0);
            return;
        }
        if (pool_ && process_ != process()) (void)pool_.release();  // threads do not survive a fork
        if (!pool_) pool_ = std::make_unique<Pool>(static_cast<int>(parts));
        process_ = process();
        pool_->for_each(count, job);
    }

    template <class Job>
    void for_each_team(Job&& job) {
        for_each(teams_.num_envs, [&](std::size_t b, int part) { job(b, scratch_[part]); });
    }

    void run(JointAction wanted, nb::handle out, bool skip_ended) {
        if (out.is_none()) return run(wanted, nullptr, skip_ended);
        const Room<T> room = room_of(out);
        const Percepts<T> percepts = percepts_of(room);
        run(wanted, &percepts, skip_ended);
    }

    void run(JointAction wanted, const Percepts<T>* percepts, bool skip_ended) {
        const std::size_t B = teams_.num_envs, N = teams_.num_agents;
        const auto ended = std::count(teams_.ended, teams_.ended + B, true);
        if (ended > 0 && !skip_ended)
            throw std::runtime_error(
                std::to_string(ended) + " of " + std::to_string(B) + " environments (the first is " +
                std::to_string(std::find(teams_.ended, teams_.ended + B, true) - teams_.ended) +
                ") have ended or were never reset: call reset(mask=...) before step");
        nb::gil_scoped_release release;
        for_each_team([&](std::size_t b, TeamScratch<T>& scratch) {
            if (teams_.ended[b]) {  // its robots do nothing and earn nothing
                std::fill_n(teams_.rewards + b * N, N, 0.0f);
                std::fill_n(teams_.replaced + b * N, N, false);
                std::fill_n(teams_.arrived + b * N, N, false);
                teams_.terminated[b] = teams_.truncated[b] = false;
                return;
            }
            step_team(teams_, options_, b, wanted, scratch);
            if (percepts != nullptr) perceive_into(b, scratch, *percepts);
        });
    }

    nb::object state_;
    Options options_;
    Teams<T> teams_{};
    std::vector<TeamScratch<T>> scratch_;
    std::vector<std::int64_t> wanted_;
    std::array<nb::object, 3> info_names_{name("replaced"), name("on_goal"), name("arrived")};
    int threads_, process_ = 0;
    std::unique_ptr<Pool> pool_;
};

template <class T>
void define(nb::module_& m, const char* name, const char* buffers) {
    nb::class_<AgentBuffers<T>>(m, buffers, "Where the observations and action masks of the only team of a batch go.");
    nb::class_<Stepper<T>>(m, name, "The rules of motion and perception, bound to the arrays of B teams.")
        .def(nb::init<nb::object, nb::handle, int>(), "state"_a, "config"_a, "threads"_a)
        .def("step", &Stepper<T>::step, "actions"_a, "out"_a.none(), "skip_ended"_a,
             "Execute joint actions (B, N) under the shield and write what the robots perceive, unless out is None.")
        .def("step_by_scores", &Stepper<T>::step_by_scores, "scores"_a, "out"_a.none(), "skip_ended"_a,
             "Execute by scores of all five actions (B, N, 5), under a shield other than \"idle\".")
        .def("observe", &Stepper<T>::observe, "out"_a, "chosen"_a.none(),
             "Write what the robots perceive, of all teams or of the chosen ones (B,).")
        .def("bag", &Stepper<T>::bag, "chosen"_a.none(),
             "The bag of the teams that are under way, all of them or the chosen ones (B,).")
        .def("agent_buffers", &Stepper<T>::agent_buffers, "out"_a, "masks"_a.noconvert(),
             "An observation of the only team and masks (N, 5) as buffers of `step_agents` and `outcome_by_agent`.")
        .def("outcome_by_agent", &Stepper<T>::outcome_by_agent, "buffers"_a, "agents"_a, "rewards"_a, "terminated"_a,
             "truncated"_a, "infos"_a,
             "Write the masks and fill dictionaries with what the last step brought to the agents of the only team.")
        .def("step_agents", &Stepper<T>::step_agents, "actions"_a, "buffers"_a, "agents"_a, "rewards"_a, "terminated"_a,
             "truncated"_a, "infos"_a,
             "Step the only team by actions by agent and fill the dictionaries; whether the episode has ended, or None "
             "if the actions cannot be read.")
        .def("begin", &Stepper<T>::begin, "chosen"_a, "seeds"_a, "limits"_a, "grids"_a, "starts"_a, "goals"_a, "sizes"_a,
             "Begin episodes of the chosen environments (M,) on instances (M, ...), all of them or none.")
        .def("ways_to", &Stepper<T>::ways_to, "team"_a, "robots"_a, "goals"_a,
             "Tables (K, rows, cols) and corners (K, 2) of K robots of a team for other goals (K, 2), and which reach them.")
        .def("write_action_masks", &Stepper<T>::write_action_masks, "Bring the state's action_mask (B, N, 5) up to date.");
}

}  // namespace

void define_stepper(nb::module_& m) {
    define<float>(m, "StepperFloat32", "AgentBuffersFloat32");
    define<std::uint8_t>(m, "StepperUint8", "AgentBuffersUint8");
    m.def("rows_by_agent", &rows_by_agent, "agents"_a, "names"_a, "columns"_a,
          "{agent: {name: column[i]}} as new dictionaries; without names {agent: column[i]}.");
}

}  // namespace mapf
