// A client's side of the wire: connect, describe, acquire a tool, send commands, receive forces (docs/wire.md).
//
// Needs zenoh-cpp over zenoh-c, and msgpack-c.
#pragma once

#include <atomic>
#include <cstdint>
#include <msgpack.hpp>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <thread>
#include <utility>
#include <variant>
#include <vector>
#include <zenoh.hxx>

#include "contract.hpp"
#include "realtime.hpp"

namespace palpate {

// There is no server, or it has gone; the message says which, in plain words.
struct ServerGone : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// The server said no, and the message is its own; or we have to, and asking again would not help.
struct Refused : std::runtime_error {
    using std::runtime_error::runtime_error;
};

struct Tool {
    std::string name;
    Vec3 start_m{};  // where the tip touches the undeformed tissue, in the model's frame
    Vec3 normal{};   // outwards, of length 1
};

struct Description {
    std::string model;  // the sha256 of what it was built from
    bool touches_anywhere = false;  // a surface model, whose tools touch wherever they are, from outside
    std::vector<Tool> tools;
    Promise promise;
};

// What is told to the server of the device that we drive.
struct DeviceTerms {
    std::string profile;
    double damping_n_s_per_m = 0.0, round_trip_s = 0.0;
};

struct Acquired {
    double max_force_n = 0.0;
    Vec3 home_m{};  // where the tip is at the tool's start, in our frame
    std::vector<std::string> warnings;  // for the user
};

struct Command {
    std::int64_t sequence = 0, client_time_ns = 0;
    Vec3 position_m{}, velocity_m_per_s{};
    std::optional<std::int64_t> rendered_tick;
};

// One client in one session, for one tool. Zenoh's threads receive and queue; all that is public here belongs to one
// other thread.
class Connection {
 public:
    Connection(const std::string& endpoint, const std::string& zenoh_config, const std::string& session,
               const std::string& client)
        : place_(place(endpoint, zenoh_config)),
          prefix_("palpate/" + session),
          client_(client),
          zenoh_(open(endpoint, zenoh_config)) {
        // The token is our sign of life: when it goes, because we are killed or cut off, the server takes our
        // tool back and lets its force fade.
        token_.emplace(zenoh_.liveliness_declare_token(prefix_ + "/client/" + client_));
        // The server has one too: it tells us when there is a server, and that it is gone faster than any
        // timeout could.
        zenoh::Session::LivelinessSubscriberOptions with_history;
        with_history.history = true;
        server_.emplace(zenoh_.liveliness_declare_subscriber(
            prefix_ + "/server",
            [this](const zenoh::Sample& sample) { (sample.get_kind() == Z_SAMPLE_KIND_PUT ? there_ : gone_) = true; },
            zenoh::closures::none, std::move(with_history)));
        statuses_.emplace(zenoh_.declare_subscriber(
            prefix_ + "/status", [this](const zenoh::Sample& sample) { guarded([&] { on_status(sample); }); },
            zenoh::closures::none));
        // Commands are worth nothing when late: no batching, and drop instead of wait.
        zenoh::Session::PublisherOptions real_time;
        real_time.priority = Z_PRIORITY_REAL_TIME;
        real_time.is_express = true;
        real_time.congestion_control = Z_CONGESTION_CONTROL_DROP;
        commands_.emplace(zenoh_.declare_publisher(prefix_ + "/command/" + client_, std::move(real_time)));
        describe();
    }

    Connection(const Connection&) = delete;
    Connection& operator=(const Connection&) = delete;

    const Description& description() const { return description_; }

    bool gone() const { return gone_; }              // the server, or the link to it
    bool stopping() const { return stopping_; }      // the server says so
    bool unreadable() const { return unreadable_; }  // it has sent what is not of docs/wire.md

    // From now on receive what each tick does with a tool.
    void receive_forces(std::size_t tool) {
        const auto receive = [this, tool](const zenoh::Sample& sample) {
            const std::int64_t arrival_ns = now_ns();
            guarded([&] { on_force(sample, tool, arrival_ns); });
        };
        forces_.emplace(zenoh_.declare_subscriber(prefix_ + "/force", receive, zenoh::closures::none));
    }

    // The next force that was received, if there is one.
    bool take(Force& force) { return received_.pop(force); }

    // Acquire a tool; only then are our commands for it used. Our frame has the model's axes and unit, and the tool's start
    // as its origin: positions are m from where the tip touches the tissue without pressing.
    Acquired acquire(const Tool& tool, const std::optional<DeviceTerms>& device) {
        tool_ = tool.name;
        msgpack::sbuffer request;
        msgpack::packer<msgpack::sbuffer> packer(request);
        begin_request(packer, device ? 5 : 2);
        packer.pack("tools").pack(std::vector<std::string>{tool.name});
        packer.pack("frame").pack_map(1).pack("model_origin_m").pack(tool.start_m);
        if (device) {
            packer.pack("device").pack(device->profile);
            packer.pack("device_damping_n_s_per_m").pack(device->damping_n_s_per_m);
            packer.pack("round_trip_s").pack(device->round_trip_s);
        }
        const auto answer = query("control/" + client_ + "/acquire", &request);
        const auto& agreed = field(field(*answer, "tools"), tool.name);
        Acquired acquired;
        acquired.max_force_n = field(field(agreed, "limits"), "max_force_n").as<double>();
        acquired.home_m = field(agreed, "home_m").as<Vec3>();
        acquired.warnings = field(*answer, "warnings").as<std::vector<std::string>>();
        return acquired;
    }

    void release() {
        msgpack::sbuffer request;
        msgpack::packer<msgpack::sbuffer> packer(request);
        begin_request(packer, 0);
        query("control/" + client_ + "/release", &request);
    }

    void send(const Command& command) {
        message_.clear();  // it keeps its memory
        msgpack::packer<msgpack::sbuffer> packer(message_);
        packer.pack_map(command.rendered_tick ? 6 : 5);
        packer.pack("kind").pack("command");
        packer.pack("sequence").pack(command.sequence);
        packer.pack("client_time_ns").pack(command.client_time_ns);
        packer.pack("position_m").pack_map(1).pack(tool_).pack(command.position_m);
        packer.pack("velocity_m_per_s").pack_map(1).pack(tool_).pack(command.velocity_m_per_s);
        if (command.rendered_tick) packer.pack("rendered_tick").pack(*command.rendered_tick);
        // A command that could not be sent is one without an answer: what then happens is the same.
        zenoh::ZResult unsent{};
        commands_->put(std::string_view(message_.data(), message_.size()),
                       zenoh::Publisher::PutOptions::create_default(), &unsent);
    }

 private:
    static constexpr std::int64_t patience_ns = 3'000'000'000;
    static constexpr int schema_version = 2;

    // What every request begins with; then its own fields follow.
    static void begin_request(msgpack::packer<msgpack::sbuffer>& packer, std::uint32_t fields) {
        packer.pack_map(fields + 2);
        packer.pack("kind").pack("request");
        packer.pack("schema_version").pack(schema_version);
    }

    static zenoh::Session open(const std::string& endpoint, const std::string& zenoh_config) {
        auto config = configuration(endpoint, zenoh_config);
        try {
            return zenoh::Session::open(std::move(config));
        } catch (const zenoh::ZException& error) {
            throw ServerGone("nothing answers at " + place(endpoint, zenoh_config) + ": " + error.what());
        }
    }

    static const std::string& place(const std::string& endpoint, const std::string& zenoh_config) {
        return zenoh_config.empty() ? endpoint : zenoh_config;
    }

    static zenoh::Config configuration(const std::string& endpoint, const std::string& zenoh_config) {
        try {
            return zenoh_config.empty() ? through(endpoint) : zenoh::Config::from_file(zenoh_config);
        } catch (const zenoh::ZException& error) {
            throw Refused(zenoh_config.empty() ? "'" + endpoint + "' is no endpoint, such as tcp/127.0.0.1:7447"
                                               : error.what());
        }
    }

    // Everything goes through the one endpoint, be it the server's or a router's; nothing is listened on or
    // looked for.
    static zenoh::Config through(const std::string& endpoint) {
        auto config = zenoh::Config::create_default();
        config.insert_json5("mode", R"("client")");
        config.insert_json5("connect/endpoints", R"([")" + endpoint + R"("])");
        config.insert_json5("connect/timeout_ms", "2000");
        config.insert_json5("connect/exit_on_failure", "true");
        config.insert_json5("scouting/multicast/enabled", "false");
        config.insert_json5("scouting/gossip/enabled", "false");
        config.insert_json5("connect/retry", R"({period_init_ms: 100, period_max_ms: 500, period_increase_factor: 2})");
        config.insert_json5("transport/unicast/open_timeout", "2000");
        config.insert_json5("transport/link/tx/lease", "4000");
        config.insert_json5("transport/link/tx/keep_alive", "8");
        return config;
    }

    void describe() {
        std::int64_t give_up_ns = now_ns() + patience_ns;
        while (!there_) {
            if (now_ns() > give_up_ns) throw ServerGone("no server for " + prefix_ + " at " + place_);
            std::this_thread::sleep_for(std::chrono::milliseconds(5));
        }
        // On the way through a router the token may be faster than what makes queries arrive: ask again for a
        // while.
        give_up_ns = now_ns() + patience_ns;
        for (;;) {
            try {
                return read_description(*query("describe"));
            } catch (const ServerGone&) {
                if (now_ns() > give_up_ns) throw;
                std::this_thread::sleep_for(std::chrono::milliseconds(50));
            }
        }
    }

    void read_description(const msgpack::object& answer) {
        const auto version = field(answer, "schema_version").as<int>();
        if (version != schema_version) {
            throw Refused("the server speaks schema version " + std::to_string(version) + ", this client " +
                          std::to_string(schema_version) + ": take both from the same version of palpate");
        }
        const auto& model = field(answer, "model");
        description_.model = field(model, "config_sha256").as<std::string>();
        description_.touches_anywhere = field(model, "kind").as<std::string>() == "surface";
        for (const auto& tool : field(answer, "tools").as<std::vector<msgpack::object>>()) {
            description_.tools.push_back({field(tool, "name").as<std::string>(), field(tool, "start_m").as<Vec3>(),
                                          field(tool, "normal").as<Vec3>()});
        }
        const auto& limits = field(answer, "limits");
        const auto& flags = field(answer, "flags");
        Promise& promise = description_.promise;
        promise.period_s = field(answer, "period_s").as<double>();
        promise.hold_s = field(answer, "hold_s").as<double>();
        promise.decay_s = field(answer, "decay_s").as<double>();
        promise.max_force_n = field(limits, "max_force_n").as<double>();
        promise.max_force_rate_n_per_s = field(limits, "max_force_rate_n_per_s").as<double>();
        promise.decaying = field(flags, "DECAYING").as<std::int64_t>();
        promise.stale = field(flags, "STALE").as<std::int64_t>();
    }

    // Ask the server; its answer. Throws Refused with its reason, ServerGone without an answer.
    msgpack::object_handle query(const std::string& key, const msgpack::sbuffer* request = nullptr) {
        zenoh::Session::GetOptions options;
        options.timeout_ms = patience_ns / 1'000'000;
        if (request) options.payload = std::string_view(request->data(), request->size());
        const auto replies = zenoh_.get(prefix_ + "/" + key, "", zenoh::channels::FifoChannel(1), std::move(options));
        const auto received = replies.recv();
        if (const auto* reply = std::get_if<zenoh::Reply>(&received)) {
            if (reply->is_ok()) return unpack(reply->get_ok().get_payload());
            const auto& error = reply->get_err();
            if (error.get_encoding().as_string().rfind("application/msgpack", 0) == 0) {  // not Zenoh's own words
                const auto refusal = unpack(error.get_payload());
                const auto reason = field(*refusal, "reason").as<std::string>();
                const auto words = field(*refusal, "message").as<std::string>() + " (" + reason + ")";
                if (reason == "stopping") throw ServerGone(words);
                throw Refused(words);
            }
        }
        throw ServerGone("no server at " + place_ + " answers " + prefix_ + "/" + key + ", or it does not let us ask");
    }

    static msgpack::object_handle unpack(const zenoh::Bytes& payload) {
        const std::string bytes = payload.as_string();
        return msgpack::unpack(bytes.data(), bytes.size());
    }

    static const msgpack::object& field(const msgpack::object& map, std::string_view name) {
        if (map.type != msgpack::type::MAP) throw std::runtime_error("the server sent no map");
        for (const auto& [key, value] : map.via.map) {
            if (key.type == msgpack::type::STR && name == std::string_view(key.via.str.ptr, key.via.str.size)) {
                return value;
            }
        }
        throw std::runtime_error("the server sent no " + std::string(name));
    }

    static const msgpack::object& element(const msgpack::object& list, std::size_t i) {
        if (list.type != msgpack::type::ARRAY || i >= list.via.array.size) {
            throw std::runtime_error("the server sent too short a list");
        }
        return list.via.array.ptr[i];
    }

    static bool is_kind(const msgpack::object& message, const char* kind) {
        return field(message, "kind").as<std::string>() == kind;
    }

    // A message of another kind than its key's is ignored.
    void on_force(const zenoh::Sample& sample, std::size_t tool, std::int64_t arrival_ns) {
        const auto message = unpack(sample.get_payload());
        if (!is_kind(*message, "force")) return;
        const auto of_tool = [&](const char* name) -> const msgpack::object& {
            return element(field(*message, name), tool);
        };
        Force force;
        force.tick = field(*message, "tick").as<std::int64_t>();
        force.sequence = of_tool("sequence").as<std::int64_t>();
        force.client_time_ns = of_tool("client_time_ns").as<std::int64_t>();
        force.input_age_ns = of_tool("input_age_ns").as<std::int64_t>();
        force.flags = of_tool("flags").as<std::int64_t>();
        force.force_n = of_tool("force_n").as<Vec3>();
        force.arrival_ns = arrival_ns;
        received_.push(force);
    }

    void on_status(const zenoh::Sample& sample) {
        const auto message = unpack(sample.get_payload());
        if (!is_kind(*message, "status")) return;
        if (field(*message, "state").as<std::string>() == "stopping") stopping_ = true;
    }

    // Zenoh's thread calls us from C, where no exception may arrive.
    template <class Work>
    void guarded(Work work) noexcept {
        try {
            work();
        } catch (const std::exception&) {
            unreadable_ = true;
        }
    }

    std::string place_, prefix_, client_, tool_;
    std::atomic<bool> there_{false}, gone_{false}, stopping_{false}, unreadable_{false};
    Queue<Force, 4096> received_;  // a query may take 3 s
    Description description_;
    msgpack::sbuffer message_;
    // What follows is taken down in reverse: nothing is called any more when the members above go.
    zenoh::Session zenoh_;
    std::optional<zenoh::LivelinessToken> token_;
    std::optional<zenoh::Publisher> commands_;
    std::optional<zenoh::Subscriber<void>> server_, statuses_, forces_;
};

}  // namespace palpate
