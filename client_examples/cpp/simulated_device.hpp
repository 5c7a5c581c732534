// The place where your device goes: copy this file, write the same functions around the driver, and build with
// `cmake -DDEVICE_HEADER=/path/to/your_device.hpp`. This one is a handle that a simulated hand moves.
#pragma once

#include <cmath>

#include "vec3.hpp"

namespace palpate {

class Device {
 public:
    // What the device itself damps: with the round trip, the server can tell from it whether the device might vibrate.
    static constexpr double damping_n_s_per_m = 0.5;

    // A device that has to be opened is opened here, and closed by the destructor; a std::exception when that fails.
    // `inwards` is a direction of length 1, into the tissue.
    explicit Device(const Vec3& inwards) : inwards_(inwards) {}

    // Where the tip is, m from where it touches the undeformed tissue, and how fast, m/s, along the model's axes. A
    // device with axes of its own turns its positions into the model's and forces back, or declares its frame in
    // Connection::acquire.
    Vec3 position_m() const { return position_ * inwards_; }
    Vec3 velocity_m_per_s() const { return velocity_ * inwards_; }

    // The force on the hand from now on, N. The motors keep it until the next call, so the last one is always zero.
    // Whatever else fails this is called with zero: it must not throw. (The other functions may; the bridge then ends.)
    void render(const Vec3& force_n) noexcept { force_ = dot(force_n, inwards_); }

    // A real device is moved by a hand: leave this empty. Here the hand is a spring to where the person wants to be,
    // 10 mm in and back once a second, on a handle of some mass. Semi-implicit Euler: as simple as it gets, and it does
    // not gain energy by itself.
    void move(double seconds) {
        constexpr double mass_kg = 0.1, hand_n_per_m = 100.0, reach_m = 0.01, turn = 2 * 3.14159265358979323846;
        const double wanted = reach_m * (1 - std::cos(turn * time_)) / 2;
        const double hand = hand_n_per_m * (wanted - position_);
        velocity_ += (hand + force_ - damping_n_s_per_m * velocity_) / mass_kg * seconds;
        position_ += velocity_ * seconds;
        time_ += seconds;
    }

 private:
    Vec3 inwards_;
    double time_ = 0.0, position_ = 0.0, velocity_ = 0.0, force_ = 0.0;  // along `inwards`
};

}  // namespace palpate
