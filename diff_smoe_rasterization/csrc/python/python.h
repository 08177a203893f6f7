// What the module _C needs of CPython: its limited API only, so that one binary serves every release from 3.8 on.
// C++ values to Python objects and back; C++ exceptions to Python's.
#pragma once

#define PY_SSIZE_T_CLEAN
#include <pyconfig.h>
#if !defined(Py_LIMITED_API) && !defined(Py_GIL_DISABLED)  // the free-threaded Python has no limited API
#define Py_LIMITED_API 0x03080000
#endif
#include <Python.h>

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace dsmoe {
namespace python {

// Thrown where Python has an error set already.
struct ErrorIsSet {};

// A reference to a Python object, which it owns.
class Object {
 public:
  Object() = default;
  // Takes a new reference; null: an error is set.
  explicit Object(PyObject* own) : object_(own) {
    if (own == nullptr) throw ErrorIsSet();
  }
  Object(const Object& other) : object_(other.object_) { Py_XINCREF(object_); }
  Object(Object&& other) noexcept : object_(std::exchange(other.object_, nullptr)) {}
  Object& operator=(Object other) noexcept {
    std::swap(object_, other.object_);
    return *this;
  }
  ~Object() { Py_XDECREF(object_); }

  static Object borrow(PyObject* object) {
    Py_XINCREF(object);
    return Object(object);
  }
  PyObject* get() const { return object_; }
  PyObject* release() { return std::exchange(object_, nullptr); }

 private:
  PyObject* object_ = nullptr;
};

inline void check_status(int status) {
  if (status < 0) throw ErrorIsSet();
}

// Text as Python's str; bytes that are no UTF-8 appear as \xNN.
Object text(const std::string& utf8);
Object bytes(const std::string& value);

inline Object to_python(Object value) { return value; }
inline Object to_python(const char* value) { return text(value); }
inline Object to_python(const std::string& value) { return text(value); }
inline Object to_python(std::nullopt_t) { return Object::borrow(Py_None); }
template <class T> Object to_python(T value) {
  static_assert(std::is_arithmetic_v<T>);
  if constexpr (std::is_same_v<T, bool>) {
    return Object::borrow(value ? Py_True : Py_False);
  } else if constexpr (std::is_floating_point_v<T>) {
    return Object(PyFloat_FromDouble(static_cast<double>(value)));
  } else if constexpr (std::is_signed_v<T>) {
    return Object(PyLong_FromLongLong(value));
  } else {
    return Object(PyLong_FromUnsignedLongLong(value));
  }
}
template <class T> Object to_python(const std::optional<T>& value) {
  return value ? to_python(*value) : Object::borrow(Py_None);
}

template <class... Values> Object tuple(const Values&... values) {
  Object out(PyTuple_New(sizeof...(Values)));
  Py_ssize_t next = 0;
  (check_status(PyTuple_SetItem(out.get(), next++, to_python(values).release())), ...);
  return out;
}

// A tuple of as many items as a list has.
template <class List> Object tuple_of(const List& list) {
  Object out(PyTuple_New(static_cast<Py_ssize_t>(std::size(list))));
  Py_ssize_t next = 0;
  for (const auto& item : list) check_status(PyTuple_SetItem(out.get(), next++, to_python(item).release()));
  return out;
}

class List {
 public:
  void append(const Object& item) { check_status(PyList_Append(object_.get(), item.get())); }
  operator Object() const { return object_; }

 private:
  Object object_{PyList_New(0)};
};

class Dict {
 public:
  template <class T> Dict& set(const char* name, const T& value) {
    check_status(PyDict_SetItemString(object_.get(), name, to_python(value).get()));
    return *this;
  }
  operator Object() const { return object_; }

 private:
  Object object_{PyDict_New()};
};

// module.name(*arguments), or where `module` is an object, its attribute.
Object import(const char* module);
Object attribute(const Object& of, const char* name);
Object call(const Object& function, const Object& arguments, const Object& keywords = Object());

// A numpy array over memory that `owner`, a capsule, keeps. type: numpy's code, such as "f4".
Object array(const void* data, const char* type, const std::vector<int64_t>& shape, const Object& owner);

template <class T> constexpr const char* kTypeCode = nullptr;
template <> inline constexpr const char* kTypeCode<float> = "f4";
template <> inline constexpr const char* kTypeCode<double> = "f8";
template <> inline constexpr const char* kTypeCode<uint8_t> = "u1";

// Hands a vector over to numpy without a copy.
template <class T> Object array(std::vector<T>&& values, const std::vector<int64_t>& shape) {
  auto owned = std::make_unique<std::vector<T>>(std::move(values));
  const Object owner(PyCapsule_New(owned.get(), nullptr, [](PyObject* capsule) {
    delete static_cast<std::vector<T>*>(PyCapsule_GetPointer(capsule, nullptr));
  }));
  const T* data = owned.release()->data();
  return array(data, kTypeCode<T>, shape, owner);
}

// The numbers of a dense numpy array, whose type must have that code.
std::pair<const void*, size_t> numbers(PyObject* array, const char* type);

[[noreturn]] void raise_type_error(const std::string& message);
uint64_t to_unsigned(PyObject* object, uint64_t largest);
std::string to_string(PyObject* object);                      // of bytes, or the UTF-8 of a str
std::vector<Object> items(PyObject* sequence);                // of a list or a tuple
std::vector<Object> items(PyObject* sequence, size_t count);  // which must be so many

// C++ values of Python objects; specialised for each type.
template <class T> struct FromPython {
  static T call(PyObject* object) {
    if constexpr (std::is_same_v<T, bool>) {
      const int value = PyObject_IsTrue(object);
      check_status(value);
      return value != 0;
    } else if constexpr (std::is_floating_point_v<T>) {
      const double value = PyFloat_AsDouble(object);
      if (value == -1 && PyErr_Occurred() != nullptr) throw ErrorIsSet();
      return static_cast<T>(value);
    } else if constexpr (std::is_unsigned_v<T>) {
      return static_cast<T>(to_unsigned(object, static_cast<T>(-1)));
    } else {
      static_assert(std::is_same_v<T, int64_t>);
      const long long value = PyLong_AsLongLong(object);
      if (value == -1 && PyErr_Occurred() != nullptr) throw ErrorIsSet();
      return value;
    }
  }
};
template <> struct FromPython<std::string> {
  static std::string call(PyObject* object) { return to_string(object); }
};
template <class T> struct FromPython<std::optional<T>> {
  static std::optional<T> call(PyObject* object) {
    if (object == Py_None) return std::nullopt;
    return FromPython<T>::call(object);
  }
};
template <class T> struct FromPython<std::vector<T>> {
  static std::vector<T> call(PyObject* object) {
    std::vector<T> out;
    for (const Object& item : items(object)) out.push_back(FromPython<T>::call(item.get()));
    return out;
  }
};
template <class T, size_t kCount> struct FromPython<std::array<T, kCount>> {
  static std::array<T, kCount> call(PyObject* object) {
    const std::vector<Object> list = items(object, kCount);
    std::array<T, kCount> out;
    for (size_t i = 0; i < kCount; ++i) out[i] = FromPython<T>::call(list[i].get());
    return out;
  }
};
template <class... Values> struct FromPython<std::tuple<Values...>> {
  static std::tuple<Values...> call(PyObject* object) {
    return values(items(object, sizeof...(Values)), std::index_sequence_for<Values...>());
  }

 private:
  template <size_t... kIndex>
  static std::tuple<Values...> values(const std::vector<Object>& list, std::index_sequence<kIndex...>) {
    return {FromPython<Values>::call(list[kIndex].get())...};
  }
};

// A dense numpy array as a vector.
template <class T> struct Array : std::vector<T> {};
template <class T> struct FromPython<Array<T>> {
  static Array<T> call(PyObject* object) {
    const auto [data, count] = numbers(object, kTypeCode<T>);
    Array<T> out;
    out.assign(static_cast<const T*>(data), static_cast<const T*>(data) + count);
    return out;
  }
};

// Other threads run Python meanwhile.
class Unlocked {
 public:
  Unlocked() : state_(PyEval_SaveThread()) {}
  ~Unlocked() { PyEval_RestoreThread(state_); }
  Unlocked(const Unlocked&) = delete;
  Unlocked& operator=(const Unlocked&) = delete;

 private:
  PyThreadState* const state_;
};

// Sets the Python error of the C++ exception that is being handled.
void set_error();

// A C++ function as the module's own.
template <class... Values, class Function> PyObject* call_function(Function function, PyObject* arguments) {
  using Result = decltype(function(std::declval<Values>()...));
  try {
    std::tuple<Values...> values = FromPython<std::tuple<Values...>>::call(arguments);
    if constexpr (std::is_void_v<Result>) {
      std::apply(function, std::move(values));
      return Object::borrow(Py_None).release();
    } else {
      return to_python(std::apply(function, std::move(values))).release();
    }
  } catch (...) {
    set_error();
    return nullptr;
  }
}

template <class Result, class... Values> struct Signature {
  template <Result (*kFunction)(Values...)> static PyObject* entry(PyObject*, PyObject* arguments) {
    return call_function<std::decay_t<Values>...>(kFunction, arguments);
  }
};
template <class Result, class... Values> Signature<Result, Values...> signature_of(Result (*)(Values...)) { return {}; }

template <auto kFunction> constexpr PyMethodDef method(const char* name) {
  return {name, &decltype(signature_of(kFunction))::template entry<kFunction>, METH_VARARGS, nullptr};
}

}  // namespace python
}  // namespace dsmoe
