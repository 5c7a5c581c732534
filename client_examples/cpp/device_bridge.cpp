// Close the loop with a haptic device: read its position, send it, render the force.
//
// Whatever ends it, the device is left without a force. Exit code 0: all well. 1: the contract was broken,
// the tool was lost, the server went away or the device failed. 2: it could not start. 130: Ctrl-C,
// SIGTERM, SIGQUIT or SIGHUP.

#include DEVICE_HEADER

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <csignal>
#include <cstdlib>
#include <iostream>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "connection.hpp"
#include "contract.hpp"
#include "realtime.hpp"

namespace palpate {
namespace {

// First in, first out. Zenoh's threads below the loop, which has to let go whatever they do, and both below
// the server's, which may be on the same machine.
constexpr int loop_priority = 60, zenoh_priority = 55;
// The server's deadlines move to where our commands come, in a quarter of a second; then round trips are measured.
constexpr double settle_s = 0.5, measure_s = 1.0;
constexpr double longest_s = 1e9;  // that an option may be: thirty years, which are still countable in ns

struct Options {
    std::string connect = "tcp/127.0.0.1:7447", zenoh_config, session = "main", name, tool, device = "generic";
    double silence_s = 0.1, wait_s = 0.0, duration_s = 5.0;
};

// Both lock-free, so that a signal's handler may use them.
std::atomic<bool> device_opened{false}, interrupted{false};

void on_signal(int) {
    if (!device_opened) _exit(130);  // nothing is rendered; our tool is free as soon as our token is gone
    interrupted = true;
}

// Thrown where we wait, so that the device is closed.
struct Interrupted {};

// While it lives forces may be rendered; at its end, however that comes, none is.
class Driving {
 public:
    explicit Driving(Device& device) : device_(device) {}
    ~Driving() { device_.render({}); }
    Driving(const Driving&) = delete;
    Driving& operator=(const Driving&) = delete;

 private:
    Device& device_;
};

// One agreement with one server: from `acquire` to `release`, or to the loss of either.
class Bridge {
 public:
    Bridge(Connection& connection, std::size_t tool, const Options& options)
        : connection_(connection),
          tool_(connection.description().tools[tool]),
          inwards_(-1.0 * tool_.normal),
          options_(options),
          period_ns_(std::llround(connection.description().promise.period_s * 1e9)),
          contract_(connection.description().promise),
          contact_(std::llround(connection.description().promise.hold_s * 1e9), inwards_,
                   connection.description().touches_anywhere) {
        connection.receive_forces(tool);
    }

    // Acquire the tool, twice: with the device's damping and the round trip, which has to be measured first,
    // the server can tell whether the device might vibrate. With a device it also watches the energy that
    // goes through our hands, and damps what would build up.
    void agree() {
        try {
            connection_.release();  // what a client of our name left behind
        } catch (const Refused&) {
        }
        const auto first = connection_.acquire(tool_, std::nullopt);
        home_m_ = first.home_m;
        contract_.agree(first.max_force_n);
        rest(settle_s);
        contract_.measure_anew();
        rest(measure_s);
        std::this_thread::sleep_for(std::chrono::milliseconds(50));  // the last answers are still under way
        take_forces();
        const auto told = contract_.round_trips().at(0.99);
        if (!told) throw ServerGone("no command was answered");
        round_trip_s_ = *told + 1e-9 * static_cast<double>(period_ns_);  // until our next step renders it
        contract_.release();
        const auto agreed =
            connection_.acquire(tool_, DeviceTerms{options_.device, Device::damping_n_s_per_m, round_trip_s_});
        take_forces();  // those of before
        contract_.agree(agreed.max_force_n);
        for (const auto& warning : agreed.warnings) std::cerr << "warning: " << warning << '\n';
    }

    // The loop: until the time is over, a signal comes, or something is lost, which it returns in plain words.
    std::optional<std::string> drive(Device& device, std::int64_t end_ns) {
        const Driving guard(device);
        deadlines_.wait();
        const std::int64_t missed_before = deadlines_.missed();
        std::optional<std::string> trouble;
        while (!interrupted && now_ns() < end_ns) {
            take_forces();
            if ((trouble = lost())) break;
            step(device);
            device.move(static_cast<double>(period_ns_) * 1e-9);
            deadlines_.wait();
        }
        missed_ = deadlines_.missed() - missed_before;
        return trouble;
    }

    // The tool is released; what was lost when that has no answer.
    std::optional<std::string> release() {
        std::this_thread::sleep_for(std::chrono::milliseconds(50));  // the last answers are still under way
        take_forces();
        contract_.release();
        try {
            connection_.release();
        } catch (const ServerGone& error) {
            return error.what();
        }
        return std::nullopt;
    }

    bool well() const { return contract_.broken().empty() && contract_.answered() > 0; }

    void print_summary() const {
        const auto& trips = contract_.round_trips();
        const auto microseconds = [](std::optional<double> seconds) {
            return seconds ? std::to_string(std::llround(*seconds * 1e6)) : "-";
        };
        std::cout << "commands answered  " << contract_.answered() << " of " << contract_.commands() << '\n'
                  << "forces             " << contract_.forces() << " received, " << contract_.lost_ticks() << " lost\n"
                  << "deadlines missed   " << missed_ << '\n'
                  << "round trip told    " << microseconds(round_trip_s_)
                  << " microseconds, until rendered\n"
                  << "round trip         p50 " << microseconds(trips.at(0.5)) << ", p99 "
                  << microseconds(trips.at(0.99)) << ", p99.9 " << microseconds(trips.at(0.999)) << ", longest "
                  << microseconds(trips.longest()) << " microseconds\n"
                  << "deepest position   " << deepest_m_ * 1e3 << " mm\n"
                  << "largest force      " << contract_.largest_force_n() << " N\n"
                  << "contract           " << (contract_.broken().empty() ? "held" : "BROKEN") << std::endl;
        for (const auto& line : contract_.broken()) std::cerr << "contract broken: " << line << '\n';
    }

 private:
    // Each period: the newest force to the motors, where the device is to the server.
    void step(Device& device) {
        const Vec3 position = device.position_m();
        deepest_m_ = std::max(deepest_m_, dot(position, inwards_));
        const std::int64_t silence_ns = now_ns() - newest_.arrival_ns;
        const auto tip = contact_.tip(position, silence_ns);
        Command command;
        command.position_m = home_m_ + tip.value_or(Vec3{});
        // The velocity lets the server carry the motion on when a command is late; the tick tells it which of
        // its forces acted until now, so that it can count the energy exactly although messages take time.
        command.velocity_m_per_s = tip ? device.velocity_m_per_s() : Vec3{};
        command.rendered_tick = rendered_tick_;
        device.render(tip && contact_.fresh(silence_ns) ? newest_.force_n : Vec3{});  // with its sign, as it comes
        rendered_tick_ = newest_.tick;
        send(command);
    }

    // Commands that keep the tip at rest, rendering nothing.
    void rest(double seconds) {
        const std::int64_t end_ns = now_ns() + std::llround(seconds * 1e9);
        while (now_ns() < end_ns && !connection_.gone()) {
            if (interrupted) throw Interrupted{};
            take_forces();
            Command command;
            command.position_m = home_m_;
            send(command);
            deadlines_.wait();
        }
    }

    void send(Command command) {
        command.sequence = ++sequence_;
        command.client_time_ns = now_ns();
        contract_.on_sending(command.sequence, command.client_time_ns);
        connection_.send(command);
    }

    // All that have come are checked; only the newest is rendered, and none that may not be.
    void take_forces() {
        for (Force force; connection_.take(force);) {
            if (contract_.on_force(force)) newest_ = force;
        }
    }

    std::optional<std::string> lost() const {
        if (connection_.stopping()) return "the server is stopping";  // it says so before it goes
        if (connection_.gone()) return "the server is gone, or the link to it: its liveliness token was taken back";
        if (connection_.unreadable()) return "the server sent what can't be read";
        if (!contract_.holding()) return "the tool is no longer ours";
        if (static_cast<double>(now_ns() - newest_.arrival_ns) > options_.silence_s * 1e9) {
            return "the server is silent: no force for " + std::to_string(options_.silence_s) + " s";
        }
        return std::nullopt;
    }

    Connection& connection_;
    const Tool& tool_;
    const Vec3 inwards_;
    const Options& options_;
    std::int64_t period_ns_;
    Deadlines deadlines_{period_ns_};
    Contract contract_;
    OneSidedContact contact_;
    Force newest_;
    Vec3 home_m_{};  // where the tip touches without pressing
    std::optional<std::int64_t> rendered_tick_;
    std::int64_t sequence_ = 0, missed_ = 0;
    double round_trip_s_ = 0.0, deepest_m_ = 0.0;
};

std::size_t find_tool(const Description& description, const std::string& name) {
    std::string names;
    for (std::size_t i = 0; i < description.tools.size(); ++i) {
        if (name.empty() || description.tools[i].name == name) return i;
        names += (i ? ", " : "") + description.tools[i].name;
    }
    throw Refused("no tool is called '" + name + "': there are " + names);
}

int run(const Options& options) {
    for (const auto& notice : {lock_memory(), raise_priority(loop_priority)}) {
        if (notice) std::cerr << "notice: " << *notice << '\n';
    }
    std::optional<Device> device;
    std::string model;
    bool well = true;
    std::int64_t end_ns = 0;  // 0 before the first agreement
    std::int64_t give_up_ns = now_ns() + std::llround(options.wait_s * 1e9);
    // When something is lost all is agreed anew, if that is wanted: nothing of the old agreement holds.
    for (;;) {
        try {
            if (interrupted) throw Interrupted{};
            raise_priority(zenoh_priority);  // Zenoh's threads inherit it
            Connection connection(options.connect, options.zenoh_config, options.session, options.name);
            raise_priority(loop_priority);
            const auto& description = connection.description();
            const std::size_t tool = find_tool(description, options.tool);
            if (!device) {
                device_opened = true;
                device.emplace(-1.0 * description.tools[tool].normal);
                device->render({});
                model = description.model;
            } else if (description.model != model) {
                throw Refused("the server that came again runs another model");
            }
            Bridge bridge(connection, tool, options);
            bridge.agree();
            if (!end_ns) end_ns = now_ns() + std::llround(options.duration_s * 1e9);
            auto trouble = bridge.drive(*device, end_ns);
            if (!trouble) trouble = bridge.release();
            bridge.print_summary();
            if (trouble) std::cerr << "device bridge: " << *trouble << '\n';
            well = well && bridge.well();
            if (interrupted) return 130;
            if (!trouble) return well ? 0 : 1;
            if (options.wait_s == 0) return 1;
            give_up_ns = now_ns() + std::llround(options.wait_s * 1e9);
        } catch (const Interrupted&) {
            return 130;
        } catch (const std::exception& error) {
            const bool may_come = dynamic_cast<const ServerGone*>(&error) && now_ns() < give_up_ns;
            if (!may_come) {
                std::cerr << "device bridge: " << error.what() << '\n';
                return end_ns ? 1 : 2;
            }
        }
        std::this_thread::sleep_for(std::chrono::milliseconds(200));
    }
}

[[noreturn]] void usage(int code) {
    const Options preset;
    (code ? std::cerr : std::cout)
        << "usage: device_bridge [options]\n"
        << "  --connect ENDPOINT   where the server listens (" << preset.connect << ")\n"
        << "  --zenoh-config FILE  Zenoh configuration to use instead of --connect\n"
        << "  --session NAME       the server's --session (" << preset.session << ")\n"
        << "  --name NAME          this client's (a random one)\n"
        << "  --tool NAME          the tool to hold (the model's first)\n"
        << "  --device NAME        profile whose limits are to hold (" << preset.device << ")\n"
        << "  --duration-s S       how long to drive the device (" << preset.duration_s << ")\n"
        << "  --silence-s S        without a force for so long, let go (" << preset.silence_s << ")\n"
        << "  --wait-s S           wait so long for a server, and when something is lost agree anew;\n"
        << "                       meanwhile nothing is rendered (" << preset.wait_s << ")\n";
    std::exit(code);
}

[[noreturn]] void wrong(const std::string& option, const std::string& text, const std::string& expected) {
    std::cerr << "device bridge: argument --" << option << ": '" << text << "' is not " << expected << '\n';
    std::exit(2);
}

Options parse(int argc, char** argv) {
    Options options;
    const std::pair<const char*, std::string*> texts[] = {
        {"connect", &options.connect}, {"zenoh-config", &options.zenoh_config}, {"session", &options.session},
        {"name", &options.name},       {"tool", &options.tool},                 {"device", &options.device}};
    const std::pair<const char*, double*> numbers[] = {
        {"duration-s", &options.duration_s}, {"silence-s", &options.silence_s}, {"wait-s", &options.wait_s}};
    std::random_device random;
    options.name = "client-" + std::to_string(random()) + "-" + std::to_string(random());
    const std::vector<std::string> words(argv + 1, argv + argc);
    for (std::size_t i = 0; i < words.size(); i += 2) {
        if (words[i] == "--help") usage(0);
        const auto is_it = [&](const auto& known) { return words[i] == std::string("--") + known.first; };
        const auto text = std::find_if(std::begin(texts), std::end(texts), is_it);
        const auto number = std::find_if(std::begin(numbers), std::end(numbers), is_it);
        if ((text == std::end(texts) && number == std::end(numbers)) || i + 1 == words.size()) usage(2);
        const std::string& value = words[i + 1];
        if (text != std::end(texts)) {
            *text->second = value;
        } else {
            char* end = nullptr;
            *number->second = std::strtod(value.c_str(), &end);
            const bool may_be_zero = number->second == &options.wait_s;
            const bool large_enough = may_be_zero ? *number->second >= 0 : *number->second > 0;
            if (value.empty() || *end || !large_enough || *number->second > longest_s) {
                wrong(number->first, value, may_be_zero ? "a number from 0 to 1e9" : "a number above 0, up to 1e9");
            }
        }
    }
    // They become parts of keys.
    const std::string plain = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-";
    for (const auto& [name, text] : {std::pair("session", options.session), std::pair("name", options.name)}) {
        if (text.empty() || text.size() > 64 || text.find_first_not_of(plain) != std::string::npos) {
            wrong(name, text, "1 to 64 of A-Z a-z 0-9 _ -");
        }
    }
    return options;
}

}  // namespace
}  // namespace palpate

int main(int argc, char** argv) {
    const auto options = palpate::parse(argc, argv);
    for (const int number : {SIGINT, SIGTERM, SIGQUIT}) std::signal(number, palpate::on_signal);
    // Under nohup a hang-up goes on being ignored.
    if (std::signal(SIGHUP, palpate::on_signal) == SIG_IGN) std::signal(SIGHUP, SIG_IGN);
    try {
        return palpate::run(options);
    } catch (...) {  // what nobody catches need not unwind, and the motors would keep their force
        std::cerr << "device bridge: the device failed, and threw no std::exception\n";
        return 1;
    }
}
