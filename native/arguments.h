// Arguments from Python, taken by name and checked. A missing, unknown or unsuitable argument raises an error that names it.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <string>
#include <type_traits>

namespace gsplat {

namespace nb = nanobind;

constexpr int64_t ANY = -1;  // a size that may take any value
constexpr int MOST_AXES = 8;

struct Shape {
    std::array<int64_t, MOST_AXES> extent{};
    int rank = 0;

    Shape() = default;
    Shape(std::initializer_list<int64_t> extents) : rank(int(extents.size())) { std::copy(extents.begin(), extents.end(), extent.begin()); }
    int64_t operator[](int axis) const { return extent[size_t(axis)]; }
    int64_t size() const {
        int64_t product = 1;
        for (int k = 0; k < rank; ++k) product *= (*this)[k];
        return product;
    }
    bool allows(const Shape &other) const {
        bool same = rank == other.rank;
        for (int k = 0; same && k < rank; ++k) same = (*this)[k] == ANY || (*this)[k] == other[k];
        return same;
    }
    std::string spelled() const {
        std::string text = "(";
        for (int k = 0; k < rank; ++k) text += (k ? ", " : "") + ((*this)[k] == ANY ? std::string("any") : std::to_string((*this)[k]));
        return text + (rank == 1 ? ",)" : ")");
    }
};

enum class Kind { F32, F64, U8, I32, I64 };

template <class T>
constexpr Kind KIND = std::is_same_v<T, float> ? Kind::F32 : Kind::F64;

inline nb::dlpack::dtype dtype_of(Kind kind) {
    switch (kind) {
        case Kind::F32:
            return nb::dtype<float>();
        case Kind::F64:
            return nb::dtype<double>();
        case Kind::U8:
            return nb::dtype<uint8_t>();
        case Kind::I32:
            return nb::dtype<int32_t>();
        default:
            return nb::dtype<int64_t>();
    }
}

inline std::string spelled(nb::dlpack::dtype type) {
    static const char *const codes[] = {"int", "uint", "float", "pointer", "bfloat", "complex", "bool"};
    return (type.code < 7 ? codes[type.code] : "type") + std::to_string(type.bits);
}

// The C interface of DLPack 1.3, which a type offers as __dlpack_c_exchange_api__. It describes a tensor without creating
// an object; `Tensor.__dlpack__` takes microseconds, and a render has twenty arrays or more.
struct ExchangeApi {
    uint32_t major, minor;
    void *older;
    void *allocate, *from_object, *to_object;
    int (*describe)(void *object, nb::dlpack::dltensor *out);
    void *stream;
};

// torch's interface; null if torch is not loaded or too old. No other type's is used, because a description cannot mark an
// array as read-only; torch's arrays never are.
inline const ExchangeApi *torch_api(nb::handle given) {
    static PyObject *tensor_type = nullptr;  // guarded by the GIL, like everything here
    static const ExchangeApi *api = nullptr;
    if (!tensor_type) {
        PyObject *torch = PyDict_GetItemString(PyImport_GetModuleDict(), "torch");
        if (!torch || !nb::hasattr(torch, "Tensor")) return nullptr;
        tensor_type = nb::object(nb::handle(torch).attr("Tensor")).release().ptr();
        if (nb::hasattr(tensor_type, "__dlpack_c_exchange_api__")) {
            const nb::object capsule = nb::handle(tensor_type).attr("__dlpack_c_exchange_api__");
            api = static_cast<const ExchangeApi *>(PyCapsule_GetPointer(capsule.ptr(), "dlpack_exchange_api"));
            PyErr_Clear();
            if (api && (api->major != 1 || !api->describe)) api = nullptr;
        }
    }
    return api && PyType_Check(tensor_type) && PyObject_TypeCheck(given.ptr(), (PyTypeObject *)tensor_type) ? api : nullptr;
}

// An array that keeps its owner alive. Empty if Python passed None.
struct Array {
    nb::object owner;
    nb::ndarray<nb::ro> held;  // if it did not come through torch's interface
    void *data = nullptr;
    Shape shape;
    nb::dlpack::dtype dtype{};
    bool contiguous = false, here = false, given = false;

    template <class T>
    T *as() const {
        return static_cast<T *>(data);
    }
    explicit operator bool() const { return given; }
    bool is(Kind kind) const { return dtype == dtype_of(kind); }
    bool overlaps(const Array &other) const {
        const auto begin = reinterpret_cast<uintptr_t>(data), from = reinterpret_cast<uintptr_t>(other.data);
        return nbytes() && other.nbytes() && begin < from + other.nbytes() && from < begin + nbytes();
    }
    uintptr_t nbytes() const { return given ? uintptr_t(shape.size()) * dtype.bits / 8 : 0; }

    void describe(const void *address, int32_t device, int rank, const int64_t *extents, const int64_t *strides) {
        data = const_cast<void *>(address), here = device == nb::device::cpu::value, given = true;
        shape.rank = rank;
        std::copy_n(extents, rank, shape.extent.begin());
        contiguous = true;
        int64_t step = 1;
        for (int k = rank; shape.size() && strides && k-- > 0; step *= shape[k])
            if (shape[k] != 1 && strides[k] != step) contiguous = false;
    }
};

// The keyword arguments of one call.
class Arguments {
  public:
    Arguments(const char *owner, const nb::args &positional, const nb::kwargs &given) : owner_(owner), given_(given) {
        if (positional.size()) throw nb::type_error((std::string(owner_) + ": takes its arguments by name only").c_str());
    }

    bool has(const char *name) const { return PyDict_GetItemString(given_.ptr(), name); }

    nb::handle take(const char *name) {
        PyObject *value = PyDict_GetItemString(given_.ptr(), name);
        if (!value) throw nb::type_error((std::string(owner_) + ": " + name + " is missing").c_str());
        if (count_ == taken_.size()) throw nb::type_error((std::string(owner_) + ": has too many arguments").c_str());
        taken_[count_++] = name;
        return value;
    }

    // Whether an argument is None, which is then taken.
    bool is_none(const char *name) {
        const bool none = take(name).is_none();
        if (!none) --count_;
        return none;
    }

    double number(const char *name) {
        const double value = real(name, take(name));
        if (!std::isfinite(value)) fail(name, "has to be finite");
        return value;
    }

    int64_t whole(const char *name, int64_t low, int64_t high) {
        int64_t value;
        if (!nb::try_cast(take(name), value) || value < low || value > high)
            fail(name, "has to be a whole number from " + std::to_string(low) + " to " + std::to_string(high));
        return value;
    }

    bool flag(const char *name) {
        bool value;
        if (!nb::try_cast(take(name), value)) fail(name, "has to be True or False");
        return value;
    }

    // `count` numbers; infinity is allowed, NaN is not.
    void numbers(const char *name, double *out, size_t count) {
        const nb::object sequence = nb::steal(PySequence_Tuple(take(name).ptr()));
        PyErr_Clear();
        if (!sequence.is_valid() || size_t(PyTuple_Size(sequence.ptr())) != count)
            fail(name, "has to be " + std::to_string(count) + " numbers");
        for (size_t k = 0; k < count; ++k) {
            out[k] = real(name, PyTuple_GetItem(sequence.ptr(), Py_ssize_t(k)));
            if (std::isnan(out[k])) fail(name, "is NaN");
        }
    }

    // A C-contiguous, aligned array in this machine's memory, of one of `kinds` and the given shape.
    Array array(const char *name, std::initializer_list<Kind> kinds, const Shape &shape, bool written = false) {
        return read(name, take(name), kinds, &shape, written);
    }

    // The same; None is allowed.
    Array array_or_none(const char *name, Kind kind, const Shape &shape, bool written = false) {
        nb::handle given = take(name);
        return given.is_none() ? Array{} : read(name, given, {kind}, &shape, written);
    }

    // The same, with any shape.
    Array array_of_any_shape(const char *name, std::initializer_list<Kind> kinds, bool written) {
        return read(name, take(name), kinds, nullptr, written);
    }

    // Refuses arguments that were not taken.
    void finish() const {
        if (given_.size() == count_) return;
        for (auto [key, value] : given_) {
            const std::string name = nb::str(key).c_str();
            if (std::find(taken_.begin(), taken_.begin() + count_, name) == taken_.begin() + count_)
                throw nb::type_error((std::string(owner_) + ": does not know " + name).c_str());
        }
    }

    [[noreturn]] void fail(const char *name, const std::string &why) const {
        throw nb::value_error((std::string(owner_) + ": " + name + ": " + why).c_str());
    }

  private:
    double real(const char *name, nb::handle given) const {
        const double value = PyFloat_AsDouble(given.ptr());
        if (value == -1.0 && PyErr_Occurred()) {
            PyErr_Clear();
            fail(name, "has to be a number");
        }
        return value;
    }

    Array read(const char *name, nb::handle given, std::initializer_list<Kind> kinds, const Shape *wanted, bool written) {
        Array found = described(given, written);
        bool fits = found && found.here && found.contiguous && (!wanted || wanted->allows(found.shape));
        fits = fits && std::any_of(kinds.begin(), kinds.end(), [&](Kind kind) { return found.is(kind); });
        if (fits && found.shape.size()) {  // an empty array may have no address
            const auto address = reinterpret_cast<uintptr_t>(found.data);
            fits = address && address % (found.dtype.bits / 8) == 0;
        }
        if (!fits) refuse(name, found, kinds, wanted, written);
        return found;
    }

    static Array described(nb::handle given, bool written) {
        Array found;
        if (const ExchangeApi *api = torch_api(given)) {
            nb::dlpack::dltensor tensor{};
            if (api->describe(given.ptr(), &tensor)) {
                PyErr_Clear();
                return found;
            }
            if (tensor.ndim > MOST_AXES) return found;
            found.owner = nb::borrow(given), found.dtype = tensor.dtype;
            const char *address = static_cast<const char *>(tensor.data);
            found.describe(address ? address + tensor.byte_offset : nullptr, tensor.device.device_type, tensor.ndim, tensor.shape,
                           tensor.strides);
            return found;
        }
        nb::ndarray<> writable;
        if (written ? nb::try_cast(given, writable, false) : nb::try_cast(given, found.held, false)) {
            if (written) found.held = nb::ndarray<nb::ro>(writable);
            if (found.held.ndim() > size_t(MOST_AXES)) return found;
            found.dtype = found.held.dtype();
            found.describe(found.held.data(), found.held.device_type(), int(found.held.ndim()), found.held.shape_ptr(),
                           found.held.stride_ptr());
        }
        return found;
    }

    [[noreturn]] void refuse(const char *name, const Array &found, std::initializer_list<Kind> kinds, const Shape *wanted,
                             bool written) const {
        std::string text = "has to be ";
        for (const Kind *kind = kinds.begin(); kind != kinds.end(); ++kind)
            text += (kind == kinds.begin() ? "" : " or ") + spelled(dtype_of(*kind));
        text += (wanted ? " of shape " + wanted->spelled() : "") + ", contiguous and aligned, in this machine's memory";
        text += written ? ", writable; got " : "; got ";
        text += found ? spelled(found.dtype) + " of shape " + found.shape.spelled() : written ? "no writable array" : "no array";
        if (found && !found.here) text += " on another device";
        if (found && !found.contiguous) text += ", not contiguous";
        fail(name, text);
    }

    const char *owner_;
    nb::kwargs given_;
    std::array<const char *, 32> taken_{};  // names that live as long as the call: literals
    size_t count_ = 0;
};

}  // namespace gsplat
