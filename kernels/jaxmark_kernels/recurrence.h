// Chebyshev's recurrence with a sparse matrix, several degrees on a block of rows while it is in cache.
//
// Rows are ordered such that neighbours have near numbers. A term of a block can be computed as soon as the term before
// is known in the block and a little beyond it, so that a front of many degrees moves through the rows, each degree a
// little behind the one before (matrix-power blocking; Alappat et al., IEEE TPDS 34(2), 2023). T_k takes the place of
// T_{k-2}, which nobody needs any more where T_k can be computed. Threads have a piece of the rows each, in which later
// degrees stop earlier before its ends; what is left around the ends is computed when both sides are done.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <type_traits>
#include <vector>

#include "crew.h"

namespace jaxmark {

constexpr int64_t kGranule = 64;  // rows; what a row reaches is known for so many together
constexpr int64_t kFewDegrees = 8;  // if the nearer cache holds fewer, the farther one is used
constexpr int kLanes = 4;         // columns that are computed together, if there are two or more

#if defined(__x86_64__) && defined(__linux__) && defined(__GNUC__) && !defined(__clang__)
#define JAXMARK_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define JAXMARK_CLONES
#endif
#if defined(__GNUC__)
#define JAXMARK_INLINE inline __attribute__((always_inline))
#else
#define JAXMARK_INLINE inline
#endif

// The rows of a matrix: (Ax)_i = own_i x_i - inverse_i Σ_s weight_si x_{table_si}, where the rest adds to the sum.
template <typename T>
struct Matrix {
  int64_t rows, slots, rest_count;
  const int32_t* table;   // [slots, rows]
  const T* weights;       // [slots, rows], or null if all are 1
  const T* own;           // [rows]
  const T* inverse;       // [rows]
  const int32_t* rest;    // [rest_count, 3]: row, column and anything, by rows; rows past the last are left out
  const T* rest_weights;  // [rest_count], or null if all are 1
  const int32_t* order;   // [rows]: which row of a signal each row is, or null if it is the same
};

template <typename T, int W>
struct LanesOf {
  typedef T Type __attribute__((vector_size(sizeof(T) * W)));
};
template <typename T>
struct LanesOf<T, 1> {
  typedef T Type;
};
template <typename T, int W>
using Lanes = typename LanesOf<T, W>::Type;

template <typename T, int W>
JAXMARK_INLINE Lanes<T, W> Load(const T* values, int64_t width) {
  Lanes<T, W> lanes = {};
  if constexpr (W == 1) {
    lanes = values[0];
  } else {
    for (int w = 0; w < width; ++w) lanes[w] = values[w];
  }
  return lanes;
}

template <typename T, int W>
JAXMARK_INLINE void Store(Lanes<T, W> lanes, T* values, int64_t width) {
  if constexpr (W == 1) {
    values[0] = lanes;
  } else {
    for (int w = 0; w < width; ++w) values[w] = lanes[w];
  }
}

// Memory for many numbers, aligned to lines of the cache.
template <typename T>
class Numbers {
 public:
  explicit Numbers(int64_t count)
      : memory_(std::aligned_alloc(64, (std::max<int64_t>(count, 1) * sizeof(T) + 63) / 64 * 64)) {
    if (memory_ == nullptr) throw std::bad_alloc();
  }
  ~Numbers() { std::free(memory_); }
  Numbers(const Numbers&) = delete;
  Numbers& operator=(const Numbers&) = delete;
  T* data() { return static_cast<T*>(memory_); }

 private:
  void* memory_;
};

// How far fronts reach: which rows of the next term can be computed from which rows of the last one.
class Reach {
 public:
  template <typename T>
  Reach(const Matrix<T>& matrix, Crew& crew) : rows_(matrix.rows) {
    const int64_t granules = (rows_ + kGranule - 1) / kGranule;
    std::vector<int64_t> high(granules, 0), low(granules, rows_);
    crew.Run(crew.threads(), [&](int64_t piece) {
      for (int64_t g = granules * piece / crew.threads(); g < granules * (piece + 1) / crew.threads(); ++g) {
        const int64_t first = g * kGranule, last = std::min(rows_, first + kGranule);
        int32_t highest = 0, lowest = static_cast<int32_t>(rows_);
        for (int64_t s = 0; s < matrix.slots; ++s) {
          const int32_t* columns = matrix.table + s * rows_;
          for (int64_t i = first; i < last; ++i) {
            highest = std::max(highest, columns[i]);
            lowest = std::min(lowest, columns[i]);
          }
        }
        high[g] = highest;
        low[g] = lowest;
      }
    });
    for (int64_t r = 0; r < matrix.rest_count; ++r) {
      const int64_t row = matrix.rest[3 * r], column = matrix.rest[3 * r + 1];
      if (row >= rows_) continue;
      high[row / kGranule] = std::max(high[row / kGranule], column);
      low[row / kGranule] = std::min(low[row / kGranule], column);
    }
    above_.assign(granules + 1, 0);
    below_.assign(granules + 1, rows_);
    int64_t total = 0;
    for (int64_t g = 0; g < granules; ++g) {
      above_[g + 1] = std::max(above_[g], high[g] + 1);
      total += std::max<int64_t>(above_[g + 1] - (g + 1) * kGranule, 0);
    }
    for (int64_t g = granules; g-- > 0;) below_[g] = std::min(below_[g + 1], low[g]);
    lag_ = total / std::max<int64_t>(granules, 1) + kGranule;
  }

  // The rows, from the first on, whose next term can be computed where the last one is known before `end`.
  int64_t Before(int64_t end) const {
    if (end >= rows_) return rows_;
    const int64_t granule = std::upper_bound(above_.begin(), above_.end(), end) - above_.begin() - 1;
    return std::min(granule * kGranule, end);
  }

  // The row from which on the next term can be computed where the last one is known from `start` on.
  int64_t After(int64_t start) const {
    if (start <= 0) return 0;
    const int64_t granule = std::lower_bound(below_.begin(), below_.end(), start) - below_.begin();
    return std::min(rows_, std::max(start, granule * kGranule));
  }

  // How many rows a degree is behind the one before, in the mean.
  int64_t lag() const { return lag_; }

 private:
  int64_t rows_, lag_;
  std::vector<int64_t> above_, below_;  // of the granules before each, the highest column; of those from it, the lowest
};

// Bytes that a thread may fill in the cache of its core, and in one that cores share.
struct Caches {
  int64_t near, far;
};

// The rows in pieces, one for each thread, and how many degrees are computed together.
struct Plan {
  int64_t rows, pieces, depth, tile;

  template <typename T>
  Plan(const Matrix<T>& matrix, const Reach& reach, int64_t threads, int64_t vectors, int64_t lanes, Caches caches)
      : rows(matrix.rows), pieces(std::max<int64_t>(threads, 1)) {
    const int64_t bytes = matrix.slots * (sizeof(int32_t) + (matrix.weights ? sizeof(T) : 0)) + 2 * sizeof(T) +
                          vectors * lanes * sizeof(T);
    const int64_t width = reach.lag() * bytes;
    const int64_t fitting = (caches.near / width < kFewDegrees ? caches.far : caches.near) / width;
    // What is left between two pieces, of the depth squared times the lag, is not shared by threads.
    depth = std::max<int64_t>(1, pieces == 1 ? fitting : std::min(fitting, rows / (8 * pieces * reach.lag())));
    tile = std::max(kGranule, reach.lag() / 2 / kGranule * kGranule);
    if (!Apart(reach)) pieces = 1;
  }

  int64_t Start(int64_t piece) const {
    const int64_t granules = (rows + kGranule - 1) / kGranule;
    return std::min(rows, granules * piece / pieces * kGranule);
  }

 private:
  // Whether the last degree leaves something of each piece, so that what is left around one end is apart from the next.
  bool Apart(const Reach& reach) const {
    for (int64_t piece = 0; piece < pieces; ++piece) {
      int64_t start = Start(piece), end = Start(piece + 1);
      for (int64_t level = 0; level < depth; ++level) start = reach.After(start), end = reach.Before(end);
      if (start > end) return false;
    }
    return true;
  }
};

// Adds c_bk T_k to the total of each band b; the compiler knows the number of bands if there is one.
template <typename T, int W, bool kOne>
struct Totals {
  int64_t rows, bands;
  Lanes<T, W>* totals;              // [bands, rows]
  const Lanes<T, W>* coefficients;  // [terms, bands]

  struct Level {
    int64_t rows, bands;
    Lanes<T, W>* __restrict totals;
    const Lanes<T, W>* __restrict c;
    Lanes<T, W> first;
    JAXMARK_INLINE void Take(int64_t i, const Lanes<T, W>& t) {
      if constexpr (kOne) {
        totals[i] += first * t;
      } else {
        for (int64_t b = 0; b < bands; ++b) totals[b * rows + i] += c[b] * t;
      }
    }
    void Finish() {}
  };
  Level At(int64_t k, int64_t) const {
    return {rows, bands, totals, coefficients + k * bands, coefficients[k * bands]};
  }
};

// Adds Σ_i u_i (T_k)_i for each k.
template <typename T, int W>
struct Projections {
  int64_t terms;
  const Lanes<T, W>* u;  // [rows]
  double* sums;          // [pieces, terms, W]

  struct Level {
    const Lanes<T, W>* u;
    double* sum;
    Lanes<T, W> total = Lanes<T, W>{};
    JAXMARK_INLINE void Take(int64_t i, const Lanes<T, W>& t) { total += u[i] * t; }
    void Finish() {
      T values[W];
      Store<T, W>(total, values, W);
      for (int w = 0; w < W; ++w) sum[w] += values[w];
    }
  };
  Level At(int64_t k, int64_t piece) const { return {u, sums + (piece * terms + k) * W}; }
};

// T_k of rows first … last - 1 in the place of T_{k-2}, as far as slots go; `now` is T_{k-1}.
template <typename T, int W, bool kWeighted, int kSlots, typename Level>
JAXMARK_INLINE void StepSlots(const Matrix<T>& matrix, int64_t first, int64_t last, T factor, const Lanes<T, W>* now,
                              Lanes<T, W>* __restrict other, Level& level) {
  const int64_t slots = kSlots ? kSlots : matrix.slots;
  for (int64_t i = first; i < last; ++i) {
    Lanes<T, W> sum = {};
    for (int64_t s = 0; s < slots; ++s) {
      const Lanes<T, W> t = now[matrix.table[s * matrix.rows + i]];
      sum += kWeighted ? matrix.weights[s * matrix.rows + i] * t : t;
    }
    const Lanes<T, W> t = factor * (matrix.own[i] * now[i] - matrix.inverse[i] * sum) - other[i];
    other[i] = t;
    level.Take(i, t);
  }
}

template <typename T, int W, typename Level>
JAXMARK_CLONES void Step(const Matrix<T>& matrix, int64_t first, int64_t last, T factor, const Lanes<T, W>* now,
                         Lanes<T, W>* other, Level& level) {
  if (matrix.weights && matrix.slots == 4) {  // so many have graphs of faces
    StepSlots<T, W, true, 4>(matrix, first, last, factor, now, other, level);
  } else if (matrix.weights) {
    StepSlots<T, W, true, 0>(matrix, first, last, factor, now, other, level);
  } else if (matrix.slots == 6) {  // surfaces of triangles have six or eight slots
    StepSlots<T, W, false, 6>(matrix, first, last, factor, now, other, level);
  } else if (matrix.slots == 8) {
    StepSlots<T, W, false, 8>(matrix, first, last, factor, now, other, level);
  } else {
    StepSlots<T, W, false, 0>(matrix, first, last, factor, now, other, level);
  }
}

// What neighbours without a slot add: the results are linear in T_k, so that it may come after the rest of it.
template <typename T, int W, typename Level>
void AddRest(const Matrix<T>& matrix, int64_t first, int64_t last, T factor, const Lanes<T, W>* now,
             Lanes<T, W>* other, Level& level) {
  int64_t low = 0, high = matrix.rest_count;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (matrix.rest[3 * middle] < first) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  for (; low < matrix.rest_count && matrix.rest[3 * low] < last; ++low) {
    const int64_t row = matrix.rest[3 * low];
    const T weight = -factor * matrix.inverse[row] * (matrix.rest_weights ? matrix.rest_weights[low] : T(1));
    const Lanes<T, W> t = weight * now[matrix.rest[3 * low + 1]];
    other[row] += t;
    level.Take(row, t);
  }
}

// Runs the recurrence over k = 1 … terms - 1, from T_0 in `even` and zeros in `odd`.
template <typename T, int W, typename Sink>
void Recur(const Matrix<T>& matrix, const Reach& reach, const Plan& plan, Crew& crew, int64_t terms, Lanes<T, W>* even,
           Lanes<T, W>* odd, const Sink& sink) {
  for (int64_t base = 1; base < terms; base += plan.depth) {
    const int64_t depth = std::min(plan.depth, terms - base);
    auto advance = [&](int64_t k, int64_t first, int64_t last, int64_t piece) {
      auto level = sink.At(k, piece);
      // T_1 = AT_0 is the recurrence with factor 1 and T_{-1} = 0.
      const T factor = k == 1 ? 1 : 2;
      Lanes<T, W>*now = k % 2 ? even : odd, *other = k % 2 ? odd : even;
      Step<T, W>(matrix, first, last, factor, now, other, level);
      AddRest<T, W>(matrix, first, last, factor, now, other, level);
      level.Finish();
    };
    crew.Run(plan.pieces, [&](int64_t piece) {
      std::vector<int64_t> done(depth);
      int64_t start = plan.Start(piece);
      for (int64_t l = 0; l < depth; ++l) done[l] = start = reach.After(start);
      for (int64_t front = plan.Start(piece); front < plan.Start(piece + 1);) {
        front = std::min(front + plan.tile, plan.Start(piece + 1));
        int64_t end = front;
        for (int64_t l = 0; l < depth; ++l) {
          end = reach.Before(end);
          if (end <= done[l]) continue;
          advance(base + l, done[l], end, piece);
          done[l] = end;
        }
      }
    });
    crew.Run(plan.pieces - 1, [&](int64_t piece) {
      int64_t end = plan.Start(piece + 1), start = end;
      for (int64_t l = 0; l < depth; ++l) {
        end = reach.Before(end);
        start = reach.After(start);
        if (end < start) advance(base + l, end, start, piece);
      }
    });
  }
}

// The lanes of a signal [rows, columns] from a column on, in the matrix's order.
template <typename T, int W>
void Enter(const Matrix<T>& matrix, const Plan& plan, Crew& crew, const T* x, int64_t columns, int64_t from,
           Lanes<T, W>* lanes) {
  crew.Run(plan.pieces, [&](int64_t piece) {
    for (int64_t i = plan.Start(piece); i < plan.Start(piece + 1); ++i) {
      const int64_t row = matrix.order ? matrix.order[i] : i;
      lanes[i] = Load<T, W>(x + row * columns + from, std::min<int64_t>(W, columns - from));
    }
  });
}

// f_b(A)x for each band b: y [bands, rows, columns] from x [rows, columns] and c [bands, terms, columns or 1].
template <typename T, int W>
void FilterColumns(const Matrix<T>& matrix, const Reach& reach, const Plan& plan, Crew& crew, int64_t bands,
                   int64_t terms, bool per_column, const T* c, const T* x, int64_t columns, int64_t from, T* y,
                   Lanes<T, W>* even, Lanes<T, W>* odd, Lanes<T, W>* totals) {
  const int64_t width = std::min<int64_t>(W, columns - from);
  Numbers<Lanes<T, W>> coefficients(terms * bands);
  for (int64_t b = 0; b < bands; ++b) {
    for (int64_t k = 0; k < terms; ++k) {
      T values[W];
      for (int w = 0; w < W; ++w) {
        const int64_t column = from + std::min<int64_t>(w, width - 1);
        values[w] = per_column ? c[(b * terms + k) * columns + column] : c[b * terms + k];
      }
      coefficients.data()[k * bands + b] = Load<T, W>(values, W);
    }
  }
  Enter<T, W>(matrix, plan, crew, x, columns, from, even);
  crew.Run(plan.pieces, [&](int64_t piece) {
    for (int64_t i = plan.Start(piece); i < plan.Start(piece + 1); ++i) {
      odd[i] = Lanes<T, W>{};
      for (int64_t b = 0; b < bands; ++b) totals[b * matrix.rows + i] = coefficients.data()[b] * even[i];
    }
  });
  if (bands == 1) {
    Recur<T, W>(matrix, reach, plan, crew, terms, even, odd,
                Totals<T, W, true>{matrix.rows, bands, totals, coefficients.data()});
  } else {
    Recur<T, W>(matrix, reach, plan, crew, terms, even, odd,
                Totals<T, W, false>{matrix.rows, bands, totals, coefficients.data()});
  }
  crew.Run(plan.pieces, [&](int64_t piece) {
    for (int64_t b = 0; b < bands; ++b) {
      for (int64_t i = plan.Start(piece); i < plan.Start(piece + 1); ++i) {
        const int64_t row = matrix.order ? matrix.order[i] : i;
        Store<T, W>(totals[b * matrix.rows + i], y + (b * matrix.rows + row) * columns + from, width);
      }
    }
  });
}

// Σ_i u_i (T_k(A)x)_i for each k < terms: y [terms, columns] from x and u [rows, columns].
template <typename T, int W>
void ProjectColumns(const Matrix<T>& matrix, const Reach& reach, const Plan& plan, Crew& crew, int64_t terms,
                    const T* x, const T* u, int64_t columns, int64_t from, T* y, Lanes<T, W>* even, Lanes<T, W>* odd,
                    Lanes<T, W>* weights) {
  std::vector<double> sums(plan.pieces * terms * W, 0.0);
  Enter<T, W>(matrix, plan, crew, x, columns, from, even);
  Enter<T, W>(matrix, plan, crew, u, columns, from, weights);
  const Projections<T, W> sink{terms, weights, sums.data()};
  crew.Run(plan.pieces, [&](int64_t piece) {
    auto level = sink.At(0, piece);
    for (int64_t i = plan.Start(piece); i < plan.Start(piece + 1); ++i) {
      odd[i] = Lanes<T, W>{};
      level.Take(i, even[i]);
    }
    level.Finish();
  });
  Recur<T, W>(matrix, reach, plan, crew, terms, even, odd, sink);
  for (int64_t k = 0; k < terms; ++k) {
    for (int64_t w = 0; w < std::min<int64_t>(W, columns - from); ++w) {
      double total = 0;
      for (int64_t piece = 0; piece < plan.pieces; ++piece) total += sums[(piece * terms + k) * W + w];
      y[k * columns + from + w] = static_cast<T>(total);
    }
  }
}

}  // namespace jaxmark
