// What a client may rely on, checked message by message, and what it has to keep to itself: docs/wire.md as
// code.
//
// Needs nothing but the standard library, and allocates nothing while all is well.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdarg>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <optional>
#include <string>
#include <vector>

#include "vec3.hpp"

namespace palpate {

// Of one tick, what concerns our tool. Times are ns; `client_time_ns` and `arrival_ns` on our own clock.
struct Force {
    std::int64_t tick = 0;
    std::int64_t sequence = -1;
    std::int64_t client_time_ns = -1;
    std::int64_t input_age_ns = -1;
    std::int64_t flags = 0;
    Vec3 force_n{};  // what the device renders: the force of the tissue on the tool
    std::int64_t arrival_ns = 0;
};

// What the server's answer to `describe` promises for every tool.
struct Promise {
    double period_s = 0.0, hold_s = 0.0, decay_s = 0.0;
    double max_force_n = 0.0, max_force_rate_n_per_s = 0.0;
    std::int64_t decaying = 0, stale = 0;  // bits
};

// Makes the contact with a patch model one-sided: the tip is in the tissue only while the hand is and forces come, and after a gap
// not before the hand has left, so that no force jumps back in. It enters where the hand enters. A surface model, which is touched
// from outside anyway, gets the hand's position as it is.
class OneSidedContact {
 public:
    // `inwards` is a unit vector. A force is held as long without a newer one as the server holds a silent input.
    OneSidedContact(std::int64_t hold_ns, const Vec3& inwards, bool touches_anywhere)
        : hold_ns_(hold_ns), inwards_(inwards), touches_anywhere_(touches_anywhere) {}

    // The tip's position for the hand's, m from where it touches without pressing; none while it is not in the tissue.
    std::optional<Vec3> tip(const Vec3& hand, std::int64_t silence_ns) {
        if (touches_anywhere_) return hand;
        const double depth = dot(hand, inwards_);
        let_go_ = silence_ns > hold_ns_ || (let_go_ && depth > 0);
        if (!let_go_ && depth > 0) return hand - entered_;
        entered_ = hand - depth * inwards_;
        return std::nullopt;
    }

    bool fresh(std::int64_t silence_ns) const { return silence_ns <= hold_ns_; }

 private:
    std::int64_t hold_ns_;
    Vec3 inwards_;
    bool touches_anywhere_;
    bool let_go_ = true;  // a hand that begins in the tissue has to leave it first
    Vec3 entered_{};      // where the hand went in, on the surface
};

// Round-trip times, counted by the microsecond: fixed memory, however long it runs.
class RoundTrips {
 public:
    void add(std::int64_t ns) {
        const auto microseconds = static_cast<std::size_t>(std::max<std::int64_t>(ns, 0) / 1000);
        ++counts_[std::min(microseconds, counts_.size() - 1)];
        ++count_;
        longest_ns_ = std::max(longest_ns_, ns);
    }

    std::int64_t count() const { return count_; }

    // The time that a share of them stays below, s, a microsecond too long at most; nothing when there are
    // none.
    std::optional<double> at(double share) const {
        if (count_ == 0) return std::nullopt;
        const auto rank = std::min(count_ - 1, static_cast<std::int64_t>(share * static_cast<double>(count_)));
        std::int64_t below = 0;
        for (std::size_t i = 0; i + 1 < counts_.size(); ++i) {
            below += counts_[i];
            if (below > rank) return static_cast<double>(i + 1) * 1e-6;
        }
        return longest();
    }

    std::optional<double> longest() const {
        return count_ ? std::optional(static_cast<double>(longest_ns_) * 1e-9) : std::nullopt;
    }

 private:
    std::vector<std::int64_t> counts_ = std::vector<std::int64_t>(100'001);  // the last: all from 0.1 s on
    std::int64_t count_ = 0, longest_ns_ = 0;
};

// Feed it every command sent and every force received, for one tool; it keeps what broke the contract.
class Contract {
 public:
    explicit Contract(const Promise& promise)
        : decaying_(promise.decaying),
          stale_(promise.stale),
          max_force_n_(promise.max_force_n),
          max_step_n_(promise.max_force_rate_n_per_s * promise.period_s),
          hold_ns_((promise.hold_s + promise.period_s) * 1e9),
          fade_ns_((promise.hold_s + promise.decay_s) * 1e9) {}

    // The answer to `acquire` is here: from now on we hold the tool, within these limits.
    void agree(double max_force_n) {
        max_force_n_ = max_force_n;
        // Forces from before may still come, after the answer to `acquire`: they tell nothing about this hold.
        first_of_hold_ = newest_sent_ + 1;
        hold_is_answered_ = false;
        holding_ = true;
    }

    // Call it before the tool is released, or acquired again: our commands are then forgotten rightly.
    void release() { holding_ = false; }

    // Call it before the command is sent: the answer may come before the sending returns.
    void on_sending(std::int64_t sequence, std::int64_t client_time_ns) {
        if (static_cast<double>(client_time_ns - newest_sent_ns_) > fade_ns_) sending_since_ns_ = client_time_ns;
        newest_sent_ns_ = client_time_ns;
        newest_sent_ = sequence;
        sent_[index(sequence)] = {sequence, client_time_ns};
        ++commands_;
    }

    // Whether nothing about this force breaks the contract: while we hold the tool, only then may it be
    // rendered.
    bool on_force(const Force& f) {
        const std::int64_t breaks = breaks_;
        check(f);
        return breaks_ == breaks;
    }

    // What was measured until now does not count.
    void measure_anew() { round_trips_ = {}; }

    bool holding() const { return holding_; }  // as far as we know
    std::int64_t commands() const { return commands_; }
    std::int64_t answered() const { return answered_; }
    std::int64_t forces() const { return forces_; }
    std::int64_t lost_ticks() const { return lost_ticks_; }
    double largest_force_n() const { return largest_force_n_; }
    const RoundTrips& round_trips() const { return round_trips_; }
    const std::vector<std::string>& broken() const { return broken_; }

 private:
    static constexpr double slack = 1e-9;               // of a newton: rounding
    static constexpr std::int64_t remembered = 10'000;  // commands: answers to older ones break the contract anyway
    static constexpr std::size_t told = 20;             // one cause can break every tick; the first ones tell
    // A busy machine or network may delay commands until the force has faded. The flags tell, and nobody has promised
    // to prevent it. Zenoh closes a link on which nothing moves for this long, so a longer silence has another cause.
    static constexpr std::int64_t longest_outage_ns = 4'000'000'000;

    struct Sent {
        std::int64_t sequence = -1, client_time_ns = 0;
    };

    static std::size_t index(std::int64_t sequence) { return static_cast<std::size_t>(sequence % remembered); }

    void check(const Force& f) {
        ++forces_;
        const double magnitude = length(f.force_n);
        if (!std::isfinite(f.force_n[0]) || !std::isfinite(f.force_n[1]) || !std::isfinite(f.force_n[2])) {
            broke(f.tick, "the force [%g, %g, %g] is not finite", f.force_n[0], f.force_n[1], f.force_n[2]);
            return;
        }
        largest_force_n_ = std::max(largest_force_n_, magnitude);
        if (magnitude > max_force_n_ + slack) {
            broke(f.tick, "the force is %g N, the limit %g N", magnitude, max_force_n_);
        }
        if ((f.flags & stale_) && magnitude > 0) {
            broke(f.tick, "the input is stale and the force still %g N", magnitude);
        }
        const auto age_ns = static_cast<double>(f.input_age_ns);
        if (!(f.flags & (decaying_ | stale_)) && age_ns > hold_ns_) {
            broke(f.tick, "the input is %g ms old and no flag says so", age_ns / 1e6);
        }
        if (holding_ && f.sequence < 0 && hold_is_answered_) {
            // The server keeps a holder's last command, however silent the holder is.
            lose();
            broke(f.tick,
                  "we no longer hold the tool, our commands are forgotten: it was released or taken back "
                  "(after a long silence, for instance), or the server has stopped or was started again");
            return;
        }
        if (!follows(f)) return;
        last_ = f;
        check_answer(f);
    }

    bool follows(const Force& f) {
        if (!last_) return true;
        if (f.tick <= last_->tick) {
            broke(f.tick, "it came after tick %lld", static_cast<long long>(last_->tick));
            return false;
        }
        lost_ticks_ += f.tick - last_->tick - 1;
        const double step = length(f.force_n - last_->force_n);
        if (f.tick == last_->tick + 1 && step > max_step_n_ + slack) {
            broke(f.tick, "the force jumped by %g N in one tick", step);
        }
        if (holding_ && f.sequence >= 0 && f.sequence < last_->sequence) {
            broke(f.tick, "it answers command %lld, the tick before answered %lld", static_cast<long long>(f.sequence),
                  static_cast<long long>(last_->sequence));
        }
        return true;
    }

    void check_answer(const Force& f) {
        if (f.sequence < 0) return;
        const Sent& sent = sent_[index(f.sequence)];
        if (sent.sequence == f.sequence && sent.client_time_ns == f.client_time_ns) {
            hold_is_answered_ = hold_is_answered_ || f.sequence >= first_of_hold_;
            if (f.sequence > newest_answered_) {
                newest_answered_ = f.sequence;
                ++answered_;
                round_trips_.add(f.arrival_ns - sent.client_time_ns);
            }
            if (holding_) check_outage(f, sent.client_time_ns);
        } else if (holding_) {  // without the tool, the answers are to other clients
            lose();
            broke(f.tick,
                  "we no longer hold the tool: it answers command %lld, which was not sent (or not at that time)",
                  static_cast<long long>(f.sequence));
        }
    }

    // That the force has faded is our own doing when we were silent, but not while we went on sending. All
    // times are on our clock: the tick began `input_age_ns` or more after its command was sent. When the
    // message comes says nothing: it may have waited while we were paused.
    void check_outage(const Force& f, std::int64_t sent_ns) {
        const std::int64_t end_ns = std::min(sent_ns + f.input_age_ns, newest_sent_ns_);
        const std::int64_t outage_ns = end_ns - std::max(sent_ns, sending_since_ns_);
        const bool in_outage = (f.flags & stale_) && outage_ns > longest_outage_ns;
        if (in_outage && !in_outage_) {
            broke(f.tick,
                  "the force has faded although we went on sending: for %.3g s no command of ours has "
                  "arrived, or they "
                  "are refused",
                  static_cast<double>(outage_ns) / 1e9);
        }
        in_outage_ = in_outage;
    }

    void lose() {
        holding_ = false;
        last_.reset();  // another server counts its own ticks, another client its own commands
    }

    __attribute__((format(printf, 3, 4))) void broke(std::int64_t tick, const char* format, ...) {
        ++breaks_;
        if (broken_.size() >= told) return;
        std::array<char, 256> what{};
        std::va_list values;
        va_start(values, format);
        std::vsnprintf(what.data(), what.size(), format, values);
        va_end(values);
        broken_.push_back("tick " + std::to_string(tick) + ": " + what.data());
    }

    std::int64_t decaying_, stale_;
    double max_force_n_, max_step_n_, hold_ns_, fade_ns_;
    bool holding_ = false, in_outage_ = false;
    std::vector<Sent> sent_ = std::vector<Sent>(remembered);
    std::int64_t commands_ = 0, answered_ = 0, forces_ = 0, lost_ticks_ = 0, newest_answered_ = -1, breaks_ = 0;
    std::int64_t newest_sent_ = -1, first_of_hold_ = 0;  // the first command since the tool was acquired
    bool hold_is_answered_ = false;                       // whether one of those has been answered
    std::int64_t newest_sent_ns_ = 0,
                 sending_since_ns_ = 0;  // since: without a pause in which our force would fade
    double largest_force_n_ = 0.0;
    RoundTrips round_trips_;
    std::optional<Force> last_;
    std::vector<std::string> broken_;
};

}  // namespace palpate
