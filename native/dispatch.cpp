// Selects the instruction set: the best one of this machine, or the one named by GSPLAT_EDU_ISA.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#include <stdexcept>
#include <string>

#include "dispatch.h"
#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace gsplat {

#if defined(__x86_64__)
namespace v2 { extern const Isa table; }
namespace v3 { extern const Isa table; }
namespace v4 { extern const Isa table; }
#elif defined(__aarch64__)
namespace neon { extern const Isa table; }
#else
namespace baseline { extern const Isa table; }
#endif

namespace {

struct Candidate {
    const Isa *table;
    bool runs;
};

struct Candidates {
    Candidate list[3];
    int count;
};

#if defined(__x86_64__)
// The level of the x86-64 psABI that processor and operating system have, by CPUID: what compilers offer for this depends on
// their runtime library, which zig replaces.
int level() {
    unsigned a = 0, b = 0, c = 0, d = 0, extended = 0, ignored = 0;
    const auto has = [](unsigned word, std::initializer_list<int> bits) {
        return std::all_of(bits.begin(), bits.end(), [word](int bit) { return word >> bit & 1; });
    };
    if (!__get_cpuid(1, &a, &b, &c, &d) || !__get_cpuid(0x80000001, &a, &b, &extended, &d)) return 1;
    if (!has(c, {0, 9, 13, 19, 20, 23}) || !has(extended, {0})) return 1;  // SSE3, SSSE3, CX16, SSE4.1, SSE4.2, POPCNT; LAHF
    // FMA, MOVBE, OSXSAVE, AVX, F16C; LZCNT; BMI1, AVX2, BMI2
    if (!has(c, {12, 22, 27, 28, 29}) || !has(extended, {5})) return 2;
    if (!__get_cpuid_count(7, 0, &a, &b, &ignored, &d) || !has(b, {3, 5, 8})) return 2;
    unsigned saved, high;  // the registers that the operating system saves; macOS adds those of AVX-512 on first use only
    asm volatile("xgetbv" : "=a"(saved), "=d"(high) : "c"(0));
    if (!has(saved, {1, 2})) return 2;
    return has(saved, {5, 6, 7}) && has(b, {16, 17, 28, 30, 31}) ? 4 : 3;  // AVX-512 F, DQ, CD, BW, VL
}
#endif

const Candidates &candidates() {
#if defined(__x86_64__)
    static const int found = level();
    static const Candidates all{{{&v2::table, found >= 2}, {&v3::table, found >= 3}, {&v4::table, found >= 4}}, 3};
#elif defined(__aarch64__)
    static const Candidates all{{{&neon::table, true}, {nullptr, false}, {nullptr, false}}, 1};
#else
    static const Candidates all{{{&baseline::table, true}, {nullptr, false}, {nullptr, false}}, 1};
#endif
    return all;
}

const Isa *chosen = nullptr;

}  // namespace

int list_isas(const char **names, int capacity) {
    int count = 0;
    for (int i = 0; i < candidates().count; ++i)
        if (candidates().list[i].runs && count < capacity) names[count++] = candidates().list[i].table->name;
    return count;
}

void choose_isa(const char *name) {
    const Isa *best = nullptr;
    std::string built, reason = "this build has no such instruction set";
    for (int i = 0; i < candidates().count; ++i) {
        const Candidate &candidate = candidates().list[i];
        built += std::string(built.empty() ? "" : ", ") + candidate.table->name + (candidate.runs ? "" : " (not on this machine)");
        const bool asked = name && !std::strcmp(name, candidate.table->name);
        if (asked && !candidate.runs) reason = "this machine lacks it";
        if (candidate.runs && (!name || asked)) best = candidate.table;
    }
    if (!best)
        throw std::invalid_argument(
            (name ? "GSPLAT_EDU_ISA=" + std::string(name) + ": " + reason : "this machine is too old for the native kernels") +
            "; there are " + built);
    chosen = best;
}

const Isa &isa() {
    if (!chosen) choose_isa(nullptr);
    return *chosen;
}

template <>
const Kernels<float> &kernels<float>() {
    return isa().f32;
}
template <>
const Kernels<double> &kernels<double>() {
    return isa().f64;
}

}  // namespace gsplat
