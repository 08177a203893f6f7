#include "python/python.h"

#include <cstring>
#include <new>
#include <stdexcept>

#include "io/cursor.h"
#include "io/file.h"

namespace dsmoe {
namespace python {

Object text(const std::string& utf8) {
  return Object(PyUnicode_DecodeUTF8(utf8.data(), static_cast<Py_ssize_t>(utf8.size()), "backslashreplace"));
}

Object bytes(const std::string& value) {
  return Object(PyBytes_FromStringAndSize(value.data(), static_cast<Py_ssize_t>(value.size())));
}

Object import(const char* module) { return Object(PyImport_ImportModule(module)); }

Object attribute(const Object& of, const char* name) { return Object(PyObject_GetAttrString(of.get(), name)); }

Object call(const Object& function, const Object& arguments, const Object& keywords) {
  return Object(PyObject_Call(function.get(), arguments.get(), keywords.get()));
}

Object array(const void* data, const char* type, const std::vector<int64_t>& shape, const Object& owner) {
  const Object numpy = import("numpy");
  int64_t count = 1;
  for (const int64_t size : shape) count *= size;
  if (count == 0) return call(attribute(numpy, "empty"), tuple(tuple_of(shape), type));
  // numpy reads this attribute, and keeps the object that has it.
  Dict interface;
  const bool read_only = false;
  interface.set("data", tuple(reinterpret_cast<uintptr_t>(data), read_only)).set("shape", tuple_of(shape));
  interface.set("typestr", std::string("=") + type).set("version", 3);
  Dict attributes;
  attributes.set("__array_interface__", Object(interface)).set("owner", owner);
  const Object holder = call(attribute(import("types"), "SimpleNamespace"), tuple(), attributes);
  return call(attribute(numpy, "asarray"), tuple(holder));
}

void raise_type_error(const std::string& message) {
  PyErr_SetString(PyExc_TypeError, message.c_str());
  throw ErrorIsSet();
}

std::pair<const void*, size_t> numbers(PyObject* array, const char* type) {
  const Object interface = attribute(Object::borrow(array), "__array_interface__");
  const auto item = [&](const char* name) {
    PyObject* found = PyDict_GetItemString(interface.get(), name);  // borrowed
    if (found == nullptr) raise_type_error(std::string("an array has no ") + name);
    return found;
  };
  const std::string given = to_string(item("typestr"));
  if (given.size() != 3 || given.compare(1, 2, type) != 0 || given[0] == '>') {
    raise_type_error("an array has type " + given + "; it must be " + type);
  }
  PyObject* strides = PyDict_GetItemString(interface.get(), "strides");
  if (strides != nullptr && strides != Py_None) raise_type_error("an array is not dense");
  size_t count = 1;
  for (const Object& size : items(item("shape"))) count *= FromPython<size_t>::call(size.get());
  const std::vector<Object> data = items(item("data"), 2);
  const void* pointer = PyLong_AsVoidPtr(data[0].get());
  if (pointer == nullptr && PyErr_Occurred() != nullptr) throw ErrorIsSet();
  return {pointer, count};
}

uint64_t to_unsigned(PyObject* object, uint64_t largest) {
  const Object index(PyNumber_Index(object));
  const unsigned long long value = PyLong_AsUnsignedLongLong(index.get());
  if (value == static_cast<unsigned long long>(-1) && PyErr_Occurred() != nullptr) throw ErrorIsSet();
  if (value > largest) {
    PyErr_SetString(PyExc_OverflowError, ("a number is above " + std::to_string(largest)).c_str());
    throw ErrorIsSet();
  }
  return value;
}

std::string to_string(PyObject* object) {
  const Object value = PyUnicode_Check(object) ? Object(PyUnicode_AsUTF8String(object)) : Object::borrow(object);
  char* data;
  Py_ssize_t size;
  check_status(PyBytes_AsStringAndSize(value.get(), &data, &size));
  return {data, static_cast<size_t>(size)};
}

std::vector<Object> items(PyObject* sequence) {
  std::vector<Object> out;
  const Py_ssize_t count = PySequence_Size(sequence);
  if (count < 0) throw ErrorIsSet();
  for (Py_ssize_t i = 0; i < count; ++i) out.emplace_back(PySequence_GetItem(sequence, i));
  return out;
}

std::vector<Object> items(PyObject* sequence, size_t count) {
  std::vector<Object> out = items(sequence);
  if (out.size() != count) {
    raise_type_error(std::to_string(out.size()) + " values are given; it must be " + std::to_string(count));
  }
  return out;
}

void set_error() {
  try {
    throw;
  } catch (const ErrorIsSet&) {
  } catch (const io::FileError& error) {
    // Made here, because Python 3.8 does not turn a bare OSError into its subclass (FileNotFoundError ...) by itself.
    try {
      const Object instance = call(Object::borrow(PyExc_OSError), tuple(error.error_number, error.reason, error.path));
      PyErr_SetObject(reinterpret_cast<PyObject*>(Py_TYPE(instance.get())), instance.get());
    } catch (const ErrorIsSet&) {
    }
  } catch (const std::bad_alloc&) {
    PyErr_NoMemory();
  } catch (const std::exception& error) {
    const bool is_value_error = dynamic_cast<const io::FormatError*>(&error) != nullptr ||
                                dynamic_cast<const std::invalid_argument*>(&error) != nullptr;
    try {
      PyErr_SetObject(is_value_error ? PyExc_ValueError : PyExc_RuntimeError, text(error.what()).get());
    } catch (const ErrorIsSet&) {
    }
  }
}

}  // namespace python
}  // namespace dsmoe
