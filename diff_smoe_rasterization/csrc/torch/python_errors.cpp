#include "python_errors.h"

// Of Python's limited API, so that one binary serves every release from 3.8 on.
#define PY_SSIZE_T_CLEAN
#include <pyconfig.h>
#if !defined(Py_LIMITED_API) && !defined(Py_GIL_DISABLED)  // the free-threaded Python has no limited API
#define Py_LIMITED_API 0x03080000
#endif
#include <Python.h>

#include <stdexcept>

// PyTorch's Python side calls ops through pybind11. That turns an exception of its class `builtin_exception` into the
// error that the virtual function sets, here one of a subclass. Declared as pybind11 has it since 2.0: C++ matches
// exceptions by the name of their class. Where a later PyTorch does not, these errors are RuntimeError.
namespace pybind11 {

class __attribute__((visibility("default"))) builtin_exception : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
  virtual void set_error() const = 0;  // is called with the GIL held
};

}  // namespace pybind11

namespace dsmoe {
namespace binding {
namespace {

class PythonError final : public pybind11::builtin_exception {
 public:
  PythonError(ErrorKind kind, const std::string& message) : builtin_exception(message), kind_(kind) {}

  void set_error() const override {
    if (kind_ != ErrorKind::kOutOfMemory) {
      PyErr_SetString(type(), what());
      return;
    }
    PyObject* const torch = PyImport_ImportModule("torch");
    PyObject* const type = torch == nullptr ? nullptr : PyObject_GetAttrString(torch, "OutOfMemoryError");
    if (type != nullptr) PyErr_SetString(type, what());
    Py_XDECREF(type);
    Py_XDECREF(torch);
  }

 private:
  PyObject* type() const {
    switch (kind_) {
      case ErrorKind::kValue:
        return PyExc_ValueError;
      case ErrorKind::kType:
        return PyExc_TypeError;
      case ErrorKind::kIndex:
        return PyExc_IndexError;
      case ErrorKind::kNotImplemented:
        return PyExc_NotImplementedError;
      default:
        return PyExc_RuntimeError;
    }
  }

  const ErrorKind kind_;
};

class Locked {
 public:
  Locked() : state_(PyGILState_Ensure()) {}
  ~Locked() { PyGILState_Release(state_); }
  Locked(const Locked&) = delete;
  Locked& operator=(const Locked&) = delete;

 private:
  const PyGILState_STATE state_;
};

}  // namespace

void raise(ErrorKind kind, const std::string& message) { throw PythonError(kind, message); }

bool forward_mode_is_open() {
  const Locked lock;
  static PyObject* forward_ad = nullptr;  // the module, kept for ever
  if (forward_ad == nullptr) forward_ad = PyImport_ImportModule("torch.autograd.forward_ad");
  PyObject* const level = forward_ad == nullptr ? nullptr : PyObject_GetAttrString(forward_ad, "_current_level");
  const long value = level == nullptr ? 0 : PyLong_AsLong(level);
  Py_XDECREF(level);
  if (PyErr_Occurred() == nullptr) return value >= 0;
  PyErr_Clear();
  return true;  // not known: every tensor is asked
}

}  // namespace binding
}  // namespace dsmoe
