// Selects the instruction set: the best one of this machine, or the one named by GSPLAT_EDU_ISA.
#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

#include "dispatch.h"

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

const Candidates &candidates() {
#if defined(__x86_64__)
    static const Candidates all{{{&v2::table, bool(__builtin_cpu_supports("x86-64-v2"))},
                                 {&v3::table, bool(__builtin_cpu_supports("x86-64-v3"))},
                                 {&v4::table, bool(__builtin_cpu_supports("x86-64-v4"))}},
                                3};
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
