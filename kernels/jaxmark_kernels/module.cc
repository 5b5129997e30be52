// The kernels as targets of JAX's foreign function interface, and the Python module that holds them.
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <unistd.h>

#include <exception>

#include "recurrence.h"

namespace ffi = xla::ffi;

namespace jaxmark {
namespace {

constexpr int64_t kUsualCache = 512 * 1024;

// Bytes of caches that a front of blocks of one thread may fill.
Caches CacheSizes() {
  int64_t near = 0, far = 0;
#if defined(_SC_LEVEL2_CACHE_SIZE)
  near = sysconf(_SC_LEVEL2_CACHE_SIZE);
  far = sysconf(_SC_LEVEL3_CACHE_SIZE);
#endif
  near = (near > 0 ? near : kUsualCache) * 3 / 4;
  // Others share the last cache.
  return {near, std::max(near, far / 8)};
}

template <ffi::DataType kType>
using Values = ffi::Buffer<kType>;
using Indices = ffi::Buffer<ffi::S32>;

template <typename B>
int64_t Size(const B& buffer) {
  return static_cast<int64_t>(buffer.element_count());
}

// Empty buffers stand for what is not there.
template <typename B>
auto DataOrNull(const B& buffer) -> decltype(buffer.typed_data()) {
  return buffer.element_count() ? buffer.typed_data() : nullptr;
}

template <typename T, ffi::DataType kType>
Matrix<T> MatrixOf(const Indices& table, const Values<kType>& weights, const Values<kType>& own,
                   const Values<kType>& inverse, const Indices& rest, const Values<kType>& rest_weights,
                   const Indices& order) {
  return {Size(own),          table.dimensions()[0], rest.dimensions()[0], table.typed_data(),      DataOrNull(weights),
          own.typed_data(),   inverse.typed_data(),  rest.typed_data(),    DataOrNull(rest_weights), DataOrNull(order)};
}

// Runs the work, and reports what it throws.
template <typename F>
ffi::Error Guarded(F work) {
  try {
    work();
    return ffi::Error::Success();
  } catch (const std::exception& problem) {
    return ffi::Error(ffi::ErrorCode::kResourceExhausted, problem.what());
  }
}

template <typename T, ffi::DataType kType, int W>
void FilterAll(const Matrix<T>& matrix, Crew& crew, const Values<kType>& c, const Values<kType>& x, T* y) {
  const int64_t columns = x.dimensions()[1], bands = c.dimensions()[0], terms = c.dimensions()[1];
  const Reach reach(matrix, crew);
  const Plan plan(matrix, reach, crew.threads(), 2 + bands, W, CacheSizes());
  Numbers<Lanes<T, W>> even(matrix.rows), odd(matrix.rows), totals(bands * matrix.rows);
  for (int64_t from = 0; from < columns; from += W) {
    FilterColumns<T, W>(matrix, reach, plan, crew, bands, terms, c.dimensions()[2] > 1, c.typed_data(), x.typed_data(),
                        columns, from, y, even.data(), odd.data(), totals.data());
  }
}

template <typename T, ffi::DataType kType>
ffi::Error Filter(ffi::ThreadPool pool, Indices table, Values<kType> weights, Values<kType> own, Values<kType> inverse,
                  Indices rest, Values<kType> rest_weights, Indices order, Values<kType> c, Values<kType> x,
                  ffi::Result<Values<kType>> y) {
  return Guarded([&] {
    Crew crew(pool);
    const auto matrix = MatrixOf<T, kType>(table, weights, own, inverse, rest, rest_weights, order);
    if (x.dimensions()[1] == 1) {
      FilterAll<T, kType, 1>(matrix, crew, c, x, y->typed_data());
    } else {
      FilterAll<T, kType, kLanes>(matrix, crew, c, x, y->typed_data());
    }
  });
}

template <typename T, ffi::DataType kType, int W>
void ProjectAll(const Matrix<T>& matrix, Crew& crew, const Values<kType>& x, const Values<kType>& u, int64_t terms,
                T* y) {
  const int64_t columns = x.dimensions()[1];
  const Reach reach(matrix, crew);
  const Plan plan(matrix, reach, crew.threads(), 3, W, CacheSizes());
  Numbers<Lanes<T, W>> even(matrix.rows), odd(matrix.rows), weights(matrix.rows);
  for (int64_t from = 0; from < columns; from += W) {
    ProjectColumns<T, W>(matrix, reach, plan, crew, terms, x.typed_data(), u.typed_data(), columns, from, y,
                         even.data(), odd.data(), weights.data());
  }
}

template <typename T, ffi::DataType kType>
ffi::Error Project(ffi::ThreadPool pool, Indices table, Values<kType> weights, Values<kType> own,
                   Values<kType> inverse, Indices rest, Values<kType> rest_weights, Indices order, Values<kType> x,
                   Values<kType> u, ffi::Result<Values<kType>> y) {
  return Guarded([&] {
    Crew crew(pool);
    const auto matrix = MatrixOf<T, kType>(table, weights, own, inverse, rest, rest_weights, order);
    const int64_t terms = y->dimensions()[0];
    if (x.dimensions()[1] == 1) {
      ProjectAll<T, kType, 1>(matrix, crew, x, u, terms, y->typed_data());
    } else {
      ProjectAll<T, kType, kLanes>(matrix, crew, x, u, terms, y->typed_data());
    }
  });
}

// What both kernels are given first: the thread pool, the matrix, and two arrays more.
template <ffi::DataType kType>
auto Binding() {
  return ffi::Ffi::Bind()
      .Ctx<ffi::ThreadPool>()
      .Arg<Indices>()
      .Arg<Values<kType>>()
      .template Arg<Values<kType>>()
      .template Arg<Values<kType>>()
      .template Arg<Indices>()
      .template Arg<Values<kType>>()
      .template Arg<Indices>()
      .template Arg<Values<kType>>()
      .template Arg<Values<kType>>()
      .template Ret<Values<kType>>();
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxmarkFilterF32, (Filter<float, ffi::F32>), Binding<ffi::F32>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxmarkFilterF64, (Filter<double, ffi::F64>), Binding<ffi::F64>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxmarkProjectF32, (Project<float, ffi::F32>), Binding<ffi::F32>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(JaxmarkProjectF64, (Project<double, ffi::F64>), Binding<ffi::F64>());

bool Add(PyObject* module, const char* name, XLA_FFI_Handler* handler) {
  PyObject* capsule = PyCapsule_New(reinterpret_cast<void*>(handler), nullptr, nullptr);
  return capsule != nullptr && PyModule_AddObject(module, name, capsule) == 0;
}

PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_targets", "Targets of JAX's foreign function interface.", -1,
                          nullptr,               nullptr,    nullptr,                                        nullptr,
                          nullptr};

}  // namespace
}  // namespace jaxmark

PyMODINIT_FUNC PyInit__targets(void) {
  PyObject* module = PyModule_Create(&jaxmark::definition);
  if (module == nullptr) return nullptr;
  if (jaxmark::Add(module, "filter_float32", jaxmark::JaxmarkFilterF32) &&
      jaxmark::Add(module, "filter_float64", jaxmark::JaxmarkFilterF64) &&
      jaxmark::Add(module, "project_float32", jaxmark::JaxmarkProjectF32) &&
      jaxmark::Add(module, "project_float64", jaxmark::JaxmarkProjectF64)) {
    return module;
  }
  Py_DECREF(module);
  return nullptr;
}
