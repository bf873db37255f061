// TD3 on Pendulum in RLtools, 64-64 networks, batch 100: steps of its own loop (one environment step and one update each), asked for
// and answered as the Python peers do. Built by run.py from a checkout of RLtools that its user names; needs OpenBLAS.
#include <rl_tools/operations/cpu_mux.h>
#include <rl_tools/nn/optimizers/adam/instance/operations_generic.h>
#include <rl_tools/nn/operations_cpu_mux.h>
#include <rl_tools/nn/layers/td3_sampling/operations_generic.h>
#include <rl_tools/rl/environments/pendulum/operations_cpu.h>
#include <rl_tools/nn_models/mlp/operations_generic.h>
#include <rl_tools/nn_models/sequential/operations_generic.h>
#include <rl_tools/nn/optimizers/adam/operations_generic.h>
#include <rl_tools/rl/algorithms/td3/loop/core/config.h>
#include <rl_tools/rl/algorithms/td3/loop/core/operations_generic.h>

#include <chrono>
#include <cstdio>
#include <ctime>
#include <iostream>
#include <string>
#include <vector>

namespace rlt = rl_tools;
using Device = rlt::devices::DEVICE_FACTORY<>;
using Rng = Device::SPEC::RANDOM::ENGINE<>;
using Types = rlt::numeric_types::Policy<float>;
using Index = typename Device::index_t;
using Pendulum = rlt::rl::environments::Pendulum<
    rlt::rl::environments::pendulum::Specification<float, Index, rlt::rl::environments::pendulum::DefaultParameters<float>>>;

// Its defaults are 3 layers of 64, batch 100 and one environment; only the length of the run differs.
struct Parameters : rlt::rl::algorithms::td3::loop::core::DefaultParameters<Types, Index, Pendulum> {
    static constexpr Index STEP_LIMIT = 1000000000;
    static constexpr Index REPLAY_BUFFER_CAP = 1000000;
    static constexpr Index ACTOR_HIDDEN_DIM = 64;
    static constexpr Index CRITIC_HIDDEN_DIM = 64;
};
using Config = rlt::rl::algorithms::td3::loop::core::Config<Types, Index, Rng, Pendulum, Parameters>;
using State = Config::State<Config>;

static double wall() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

static double processor() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

static void steps(Device& device, State& state, int n) {
    for (int i = 0; i < n; i++) rlt::step(device, state);
}

static void print(const char* name, const std::vector<double>& values) {
    std::printf("\"%s\": [", name);
    for (size_t i = 0; i < values.size(); i++) std::printf("%s%.3f", i ? ", " : "", values[i]);
    std::printf("]");
}

int main() {
    Device device;
    State state;
    rlt::malloc(device, state);
    rlt::init(device, state, 0);
    std::string line;
    while (std::getline(std::cin, line)) {
        const auto at = line.find("\"seconds\": ");
        const double seconds = at == std::string::npos ? 1.0 : std::stod(line.substr(at + 11));
        steps(device, state, 300);
        std::vector<double> rates, cpu_rates;
        for (const double begin = wall(); wall() - begin < seconds;) {
            const double wall_s = wall(), cpu_s = processor();
            steps(device, state, 50);
            rates.push_back(50 / (wall() - wall_s));
            cpu_rates.push_back(50 / std::max(processor() - cpu_s, 1e-9));
        }
        std::printf("{");
        print("rates", rates);
        std::printf(", ");
        print("cpu_rates", cpu_rates);
        std::printf("}\n");
        std::fflush(stdout);
    }
    rlt::free(device, state);
}
