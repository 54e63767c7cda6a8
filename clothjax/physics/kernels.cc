// Energies and relaxation of cloth, sums of blend shapes, a sparse solve and searches, as functions that XLA calls: see
// kernels.py.
//
// Energies and relaxation compute several garments of a batch at once: each number is a vector with one lane for each
// garment, `Four` or `Eight`, or a float of one. So a corner is read and its gradient added with no gather and no
// scatter. Where there are fewer garments than lanes, the last one is computed again.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <type_traits>
#include <utility>
#include <vector>

#include "nearest.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;
using Result = ffi::ResultBuffer<ffi::F32>;
using Indices = ffi::ResultBuffer<ffi::S32>;

typedef float Four __attribute__((vector_size(4 * sizeof(float))));
typedef float Eight __attribute__((vector_size(8 * sizeof(float))));

constexpr size_t BLOCK = 16;       // elements whose energies are added up in single precision
constexpr size_t CHUNK = 1024;     // numbers of a blend shape that stay in the nearest cache
constexpr size_t TOGETHER = 4;     // blend shapes that are read together
constexpr size_t COLUMNS = 24;     // right-hand sides that are solved for together
constexpr float SLIVER = 1e-6f;    // twice the area, over a hinge's squared size, below which a face has no direction

template <typename T>
constexpr size_t lanes() {
  return sizeof(T) / sizeof(float);
}

template <typename T>
static inline float lane(const T &all, size_t l) {
  if constexpr (lanes<T>() == 1)
    return all;
  else
    return all[l];
}

// As many whole numbers.
template <typename T>
struct Whole {
  using type = decltype(T{} > T{});
};

template <>
struct Whole<float> {
  using type = int32_t;
};

template <typename T>
struct Three {
  T x, y, z;
};

template <typename T>
static inline Three<T> operator+(const Three<T> &a, const Three<T> &b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}

template <typename T>
static inline Three<T> operator-(const Three<T> &a, const Three<T> &b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}

template <typename T>
static inline Three<T> operator*(const T &s, const Three<T> &a) {
  return {s * a.x, s * a.y, s * a.z};
}

template <typename T>
static inline void operator+=(Three<T> &a, const Three<T> &b) {
  a.x += b.x, a.y += b.y, a.z += b.z;
}

template <typename T>
static inline T dot(const Three<T> &a, const Three<T> &b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <typename T>
static inline Three<T> cross(const Three<T> &a, const Three<T> &b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// 1 / sqrt(x) of a positive x, by three steps of Newton.
template <typename T>
static inline T inverse_root(T x) {
  typename Whole<T>::type bits;
  T y;
  std::memcpy(&bits, &x, sizeof bits);
  bits = 0x5f3759df - (bits >> 1);
  std::memcpy(&y, &bits, sizeof y);
  for (int i = 0; i < 3; i++) y *= 1.5f - 0.5f * x * y * y;
  return y;
}

// The arc tangent of y / x (Abramowitz and Stegun 4.4.49), without a branch.
template <typename T>
static inline T arc(T y, T x) {
  const T zero = {}, a = x < zero ? -x : x, b = y < zero ? -y : y, more = a > b ? a : b, less = a > b ? b : a;
  const T q = less / (more > zero ? more : zero + 1.0f), t = q * q;
  T angle = q * (1.0f + t * (-0.3333314528f + t * (0.1999355085f + t * (-0.1420889944f + t * (0.1065626393f +
            t * (-0.0752896400f + t * (0.0429096138f + t * (-0.0161657367f + t * 0.0028662257f))))))));
  angle = b > a ? 1.57079633f - angle : angle;
  angle = x < zero ? 3.14159265f - angle : angle;
  return y < zero ? -angle : angle;
}

// Rows of numbers of the garments that are computed at once.
template <typename T>
struct Rows {
  const float *of[lanes<T>()];

  T operator[](size_t i) const {
    if constexpr (lanes<T>() == 1) {
      return of[0][i];
    } else {
      T all;
      for (size_t l = 0; l < lanes<T>(); l++) all[l] = of[l][i];
      return all;
    }
  }

  Three<T> three(size_t i) const { return {(*this)[3 * i], (*this)[3 * i + 1], (*this)[3 * i + 2]}; }
};

template <typename T>
using Points = std::vector<Three<T>>;

template <typename T>
static Points<T> points(const Rows<T> &rows, size_t count) {
  Points<T> all(count);
  for (size_t v = 0; v < count; v++) all[v] = rows.three(v);
  return all;
}

// Energies of elements: sums of blocks, added up in double precision.
template <typename T>
struct Sum {
  double total[lanes<T>()] = {0};
  T part = {};
  size_t parts = 0;

  void add(T energy) {
    part += energy;
    if (++parts == BLOCK) flush();
  }

  void flush() {
    for (size_t l = 0; l < lanes<T>(); l++) total[l] += lane(part, l);
    part = T{}, parts = 0;
  }
};

// Which vertices are the k corners of elements, [count][k].
template <size_t k>
struct Elements {
  size_t count;
  const int32_t *corner;

  size_t at(size_t c, size_t i) const { return (size_t)corner[k * i + c]; }
};

// A face: the inverse of its shape at rest ((a, b), (c, d)), 1/m, and how it resists, J.
template <typename T>
struct Face {
  T a, b, c, d, mu, lam;
};

// The deformation gradient of a face, or its change; or its first Piola-Kirchhoff stress, or that one's change.
template <typename T>
struct Columns {
  Three<T> u, v;
};

template <typename T>
static inline Columns<T> deformed(const Face<T> &f, const Three<T> &p, const Three<T> &q, const Three<T> &r) {
  const Three<T> l = p - r, m = q - r;
  return {f.a * l + f.c * m, f.b * l + f.d * m};
}

// The second Piola-Kirchhoff stress ((s, t), (t, u)) of Saint Venant and Kirchhoff, or its change, by Green's strain.
template <typename T>
struct Stress {
  T s, t, u;
};

template <typename T>
static inline Stress<T> stress(const Face<T> &f, T along, T shear, T across) {
  const T all = f.lam * (along + across), twice = 2.0f * f.mu;
  return {twice * along + all, twice * shear, twice * across + all};
}

template <typename T>
static inline Columns<T> times(const Columns<T> &by, const Stress<T> &of) {
  return {of.s * by.u + of.t * by.v, of.t * by.u + of.u * by.v};
}

// Adds the gradient of a face to that of its corners.
template <typename T>
static inline void to_corners(const Face<T> &f, const Columns<T> &of, Three<T> &p, Three<T> &q, Three<T> &r) {
  const Three<T> g = f.a * of.u + f.b * of.v, h = f.c * of.u + f.d * of.v;
  p += g, q += h, r = r - (g + h);
}

// Saint Venant-Kirchhoff: adds the energies of faces to `sum`, and their gradients to those of the vertices.
template <typename T, typename Faces>
static inline void stretching(const Elements<3> &corners, const Faces &faces, const Points<T> &x, Points<T> &gradient,
                              Sum<T> &sum) {
  for (size_t i = 0; i < corners.count; i++) {
    const size_t p = corners.at(0, i), q = corners.at(1, i), r = corners.at(2, i);
    const Face<T> f = faces[i];
    const Columns<T> F = deformed(f, x[p], x[q], x[r]);
    const T along = 0.5f * (dot(F.u, F.u) - 1.0f), shear = 0.5f * dot(F.u, F.v), across = 0.5f * (dot(F.v, F.v) - 1.0f);
    const T trace = along + across;
    sum.add(f.mu * (along * along + 2.0f * shear * shear + across * across) + 0.5f * f.lam * trace * trace);
    to_corners(f, times(F, stress(f, along, shear, across)), gradient[p], gradient[q], gradient[r]);
  }
}

// Adds the Hessian of the stretching energy times a move of the vertices (energies.stretching_hessian_product).
template <typename T>
static void stretching_along(const Elements<3> &corners, const std::vector<Face<T>> &faces, const Points<T> &x,
                             const Points<T> &move, Points<T> &product) {
  for (size_t i = 0; i < corners.count; i++) {
    const size_t p = corners.at(0, i), q = corners.at(1, i), r = corners.at(2, i);
    const Face<T> &f = faces[i];
    const Columns<T> F = deformed(f, x[p], x[q], x[r]), d = deformed(f, move[p], move[q], move[r]);
    const T along = 0.5f * (dot(F.u, F.u) - 1.0f), shear = 0.5f * dot(F.u, F.v), across = 0.5f * (dot(F.v, F.v) - 1.0f);
    const T sheared = 0.5f * (dot(F.u, d.v) + dot(F.v, d.u));
    const Columns<T> held = times(d, stress(f, along, shear, across));
    const Columns<T> turned = times(F, stress(f, dot(F.u, d.u), sheared, dot(F.v, d.v)));
    to_corners(f, {held.u + turned.u, held.v + turned.v}, product[p], product[q], product[r]);
  }
}

// The dihedral energy (energies.bending), of stiffnesses k / (8 A).
template <typename T>
static void bending(const Elements<4> &hinges, const Rows<T> &stiffnesses, const Rows<T> &rest, const Points<T> &x,
                    Points<T> &gradient, Sum<T> &sum) {
  const T zero = {}, one = zero + 1.0f;
  for (size_t i = 0; i < hinges.count; i++) {
    const size_t p = hinges.at(0, i), q = hinges.at(1, i), r = hinges.at(2, i), t = hinges.at(3, i);
    const T stiffness = stiffnesses[i];
    const Three<T> e = x[q] - x[p], left = x[r] - x[p], right = x[t] - x[p];
    const Three<T> n = cross(e, left), o = cross(right, e);
    const T sine = dot(cross(n, o), e), cosine = dot(n, o), edge = dot(e, e), ll = dot(left, left);
    const T rr = dot(right, right), longest = edge > ll ? edge : ll, size = longest > rr ? longest : rr;
    T ee = edge, nn = dot(n, n), oo = dot(o, o);
    const T bent = (nn < oo ? nn : oo) > SLIVER * SLIVER * size * size ? one : zero;
    ee += 1.0f - bent, nn += 1.0f - bent, oo += 1.0f - bent;  // where it is flat they are nearly zero
    const T length = ee * inverse_root(ee), angle = bent * arc(sine, cosine * length) - rest[i];
    const T w = 2.0f * stiffness, torque = bent * w * ee * angle * length, longer = w * angle * angle;
    sum.add(stiffness * edge * angle * angle);
    const T u = -torque / nn, v = -torque / oo, a = u * dot(left, e) / ee, b = v * dot(right, e) / ee;
    const Three<T> s = a * n + b * o - longer * e, to_left = u * n, to_right = v * o;
    gradient[p] += s - to_left - to_right, gradient[q] = gradient[q] - s;
    gradient[r] += to_left, gradient[t] += to_right;
  }
}

// The energy of edges in the body (incremental_potential.edge_collision), of planes at places between the ends.
template <typename T>
static void edge_collision(const Elements<2> &edges, const Rows<T> &places, const Rows<T> &planes,
                           const Rows<T> &normals, float stiffness, float offset, const Points<T> &x,
                           Points<T> &gradient, Sum<T> &sum) {
  const T zero = {};
  for (size_t i = 0; i < edges.count; i++) {
    const size_t p = edges.at(0, i), q = edges.at(1, i);
    const T place = places[i];
    const Three<T> normal = normals.three(i), from = x[p] - planes.three(i) + place * (x[q] - x[p]);
    const T inside = offset - dot(from, normal), depth = inside > zero ? inside : zero;
    sum.add(stiffness * depth * depth * depth);
    const Three<T> force = (-3.0f * stiffness * depth * depth) * normal;
    gradient[p] += (1.0f - place) * force, gradient[q] += place * force;
  }
}

// What relaxation.relaxed reads: it moves a vertex by m / sqrt(1 + |m|^2 / longest^2), with the move m = -(1 + momentum)
// mobility gradient.
template <typename T>
struct Relaxing {
  Elements<3> corners;
  std::vector<Face<T>> faces;
  Rows<T> mobility;
  float momentum, longest;

  T factor(size_t v) const { return -(1.0f + momentum) * mobility[v]; }
  T share(const Three<T> &m) const { return inverse_root(1.0f + dot(m, m) * (1.0f / (longest * longest))); }
};

// A step from x, which a step from `before` led to: the gradient at x, and the next positions.
template <typename T>
static void relax(const Relaxing<T> &by, const Points<T> &before, const Points<T> &x, Points<T> &gradient,
                  Points<T> &next) {
  Sum<T> unused;
  const T momentum = T{} + by.momentum;
  std::fill(gradient.begin(), gradient.end(), Three<T>{});
  stretching(by.corners, by.faces, x, gradient, unused);
  for (size_t v = 0; v < x.size(); v++) {
    const Three<T> m = by.factor(v) * gradient[v];
    next[v] = x[v] + by.share(m) * m + momentum * (x[v] - before[v]);
  }
}

// The derivative M of the move by the gradient, which is symmetric, times `by`.
template <typename T>
static void moved(const Relaxing<T> &of, const Points<T> &gradient, const Points<T> &by, Points<T> &pushed) {
  const float square = 1.0f / (of.longest * of.longest);
  for (size_t v = 0; v < by.size(); v++) {
    const T factor = of.factor(v);
    const Three<T> m = factor * gradient[v];
    const T share = of.share(m), along = dot(m, by[v]) * square * share * share;
    pushed[v] = (factor * share) * (by[v] - along * m);
  }
}

// Calls a function for several garments of a batch at once: it is given numbers with lanes, and the first garment.
template <typename Work>
static void in_lanes(size_t count, Work work) {
  for (size_t first = 0; first < count;)
    if (count - first > lanes<Four>())
      work(Eight{}, first), first += lanes<Eight>();
    else if (count - first > 1)
      work(Four{}, first), first += lanes<Four>();
    else
      work(0.0f, first), first += 1;
}

// The garments of a batch that one jax.vmap made. An operand that they share has an axis of 1, or none.
template <typename Buffer>
static auto row(const Buffer &of, size_t length, size_t index) {
  return of.typed_data() + (of.element_count() == length ? 0 : index * length);
}

// The rows of the garments from `first` on; past the last of them, the last again.
template <typename T>
static Rows<T> rows(const Floats &of, size_t length, size_t first, size_t count) {
  Rows<T> all;
  for (size_t l = 0; l < lanes<T>(); l++) all.of[l] = row(of, length, std::min(first + l, count - 1));
  return all;
}

// Writes the garments from `first` on.
template <typename T>
static void write(const Points<T> &from, size_t first, size_t count, float *to) {
  const size_t V = from.size(), there = std::min(lanes<T>(), count - first);
  for (size_t l = 0; l < there; l++) {
    float *own = to + 3 * V * (first + l);
    for (size_t v = 0; v < V; v++) {
      own[3 * v] = lane(from[v].x, l), own[3 * v + 1] = lane(from[v].y, l), own[3 * v + 2] = lane(from[v].z, l);
    }
  }
}

template <typename Buffer = Floats>
static bool fit(size_t count, std::initializer_list<std::pair<const Buffer *, size_t>> operands) {
  for (auto [of, length] : operands)
    if (of->element_count() != length && of->element_count() != count * length) return false;
  return true;
}

static ffi::Error unfit() {
  return ffi::Error::InvalidArgument("operands do not fit: kernels of cloth take batches of one jax.vmap");
}

template <typename Buffer>
static size_t from_last(const Buffer &of, size_t back) {
  return of.dimensions()[of.dimensions().size() - 1 - back];
}

// Whether all of a batch share a table.
static bool shared(const Integers &table) { return table.element_count() == from_last(table, 0) * from_last(table, 1); }

template <size_t k>
static Elements<k> elements(const Integers &corner) {
  return {from_last(corner, 1), corner.typed_data()};
}

// Whether these are elements [n][k], the same for all of a batch, of vertices that there are.
template <size_t k>
static bool among(size_t vertices, const Integers &corner) {
  if (!shared(corner) || from_last(corner, 0) != k) return false;
  return std::all_of(corner.typed_data(), corner.typed_data() + corner.element_count(),
                     [&](int32_t vertex) { return (uint32_t)vertex < vertices; });
}

// The faces of several garments, which are read as they are used.
template <typename T>
struct Sheet {
  Rows<T> inverse, mu, lam;

  Face<T> operator[](size_t i) const {
    return {inverse[4 * i], inverse[4 * i + 1], inverse[4 * i + 2], inverse[4 * i + 3], mu[i], lam[i]};
  }
};

template <typename T>
static Sheet<T> sheet(size_t n, const Floats &inverse, const Floats &mu, const Floats &lam, size_t first,
                      size_t count) {
  return {rows<T>(inverse, 4 * n, first, count), rows<T>(mu, n, first, count), rows<T>(lam, n, first, count)};
}

// Computes energies of elements of a batch, and their gradients: `add` is given the first garment of several, their
// positions, their gradients, and a sum of energies.
template <size_t k, typename Add>
static ffi::Error energies(const Floats &x, const Integers &corner, Result energy, Result gradient, Add add) {
  const size_t V = from_last(x, 1), count = energy->element_count();
  if (!fit(count, {{&x, 3 * V}}) || !among<k>(V, corner)) return unfit();
  in_lanes(count, [&](auto numbers, size_t first) {
    using T = decltype(numbers);
    const Points<T> at = points(rows<T>(x, 3 * V, first, count), V);
    Points<T> by(V);
    Sum<T> sum;
    add(first, at, by, sum);
    sum.flush();
    for (size_t l = 0; l < lanes<T>() && first + l < count; l++) energy->typed_data()[first + l] = (float)sum.total[l];
    write(by, first, count, gradient->typed_data());
  });
  return ffi::Error::Success();
}

static ffi::Error Stretching(Floats x, Integers corner, Floats inverse, Floats mu, Floats lam, Result energy,
                             Result gradient) {
  const Elements<3> corners = elements<3>(corner);
  const size_t n = corners.count, count = energy->element_count();
  if (!fit(count, {{&inverse, 4 * n}, {&mu, n}, {&lam, n}})) return unfit();
  return energies<3>(x, corner, energy, gradient, [&](size_t first, const auto &at, auto &by, auto &sum) {
    stretching(corners, sheet<std::decay_t<decltype(sum.part)>>(n, inverse, mu, lam, first, count), at, by, sum);
  });
}

static ffi::Error Bending(Floats x, Integers corner, Floats stiffness, Floats angle, Result energy, Result gradient) {
  const Elements<4> hinges = elements<4>(corner);
  const size_t n = hinges.count, count = energy->element_count();
  if (!fit(count, {{&stiffness, n}, {&angle, n}})) return unfit();
  return energies<4>(x, corner, energy, gradient, [&](size_t first, const auto &at, auto &by, auto &sum) {
    using T = std::decay_t<decltype(sum.part)>;
    bending(hinges, rows<T>(stiffness, n, first, count), rows<T>(angle, n, first, count), at, by, sum);
  });
}

static ffi::Error EdgeCollision(Floats x, Integers corner, Floats place, Floats point, Floats normal, float stiffness,
                                float offset, Result energy, Result gradient) {
  const Elements<2> edges = elements<2>(corner);
  const size_t n = edges.count, count = energy->element_count();
  if (!fit(count, {{&place, n}, {&point, 3 * n}, {&normal, 3 * n}})) return unfit();
  return energies<2>(x, corner, energy, gradient, [&](size_t first, const auto &at, auto &by, auto &sum) {
    using T = std::decay_t<decltype(sum.part)>;
    edge_collision(edges, rows<T>(place, n, first, count), rows<T>(point, 3 * n, first, count),
                   rows<T>(normal, 3 * n, first, count), stiffness, offset, at, by, sum);
  });
}

template <typename T>
static Relaxing<T> relaxing(const Floats &mobility, const Integers &corner, const Floats &inverse, const Floats &mu,
                            const Floats &lam, float momentum, float longest, size_t V, size_t first, size_t count) {
  const Elements<3> corners = elements<3>(corner);
  const Sheet<T> faces = sheet<T>(corners.count, inverse, mu, lam, first, count);
  std::vector<Face<T>> all(corners.count);
  for (size_t i = 0; i < corners.count; i++) all[i] = faces[i];
  return {corners, std::move(all), rows<T>(mobility, V, first, count), momentum, longest};
}

static ffi::Error Relax(Floats x, Floats mobility, Integers corner, Floats inverse, Floats mu, Floats lam,
                        int32_t steps, float momentum, float longest, Result after) {
  const size_t V = from_last(x, 1), n = from_last(corner, 1), count = after->element_count() / (3 * V);
  if (!fit(count, {{&x, 3 * V}, {&mobility, V}, {&inverse, 4 * n}, {&mu, n}, {&lam, n}}) || !among<3>(V, corner))
    return unfit();
  in_lanes(count, [&](auto numbers, size_t first) {
    using T = decltype(numbers);
    const Relaxing<T> by =
        relaxing<T>(mobility, corner, inverse, mu, lam, momentum, longest, V, first, count);
    Points<T> at = points(rows<T>(x, 3 * V, first, count), V), before = at, next(V), gradient(V);
    for (int32_t i = 0; i < steps; i++) {
      relax(by, before, at, gradient, next);
      before.swap(at), at.swap(next);
    }
    write(at, first, count, after->typed_data());
  });
  return ffi::Error::Success();
}

static ffi::Error RelaxBack(Floats cotangent, Floats x, Floats mobility, Integers corner, Floats inverse, Floats mu,
                            Floats lam, int32_t steps, float momentum, float longest, Result by) {
  const size_t V = from_last(x, 1), n = from_last(corner, 1), count = by->element_count() / (3 * V);
  if (!fit(count, {{&cotangent, 3 * V}, {&x, 3 * V}, {&mobility, V}, {&inverse, 4 * n}, {&mu, n}, {&lam, n}}) ||
      !among<3>(V, corner))
    return unfit();
  in_lanes(count, [&](auto numbers, size_t first) {
    using T = decltype(numbers);
    const Relaxing<T> of =
        relaxing<T>(mobility, corner, inverse, mu, lam, momentum, longest, V, first, count);
    std::vector<Points<T>> at(steps + 1, Points<T>(V)), gradient(steps, Points<T>(V));
    at[0] = points(rows<T>(x, 3 * V, first, count), V);
    for (int32_t i = 0; i < steps; i++) relax(of, at[i ? i - 1 : 0], at[i], gradient[i], at[i + 1]);
    Points<T> to = points(rows<T>(cotangent, 3 * V, first, count), V), pushed(V), later, held(V);
    const T further = T{} + momentum;
    for (int32_t i = steps - 1; i >= 0; i--) {
      // `to` is by the positions after step i; those before it also took part in step i + 1, by `held`
      later = to;
      moved(of, gradient[i], later, pushed);
      stretching_along(of.corners, of.faces, at[i], pushed, to);
      for (size_t v = 0; v < V; v++) {
        to[v] += held[v];
        if (i) to[v] += further * later[v];  // the first step has none before it
        held[v] = -further * later[v];
      }
    }
    write(to, first, count, by->typed_data());
  });
  return ffi::Error::Success();
}

// Solves L D L^T x = b for many b [...][V][3]. Given are the columns of L below its diagonal of ones, in the order in
// which vertices are eliminated, and 1 / D. Vertices that are not in the order get zeros.
static ffi::Error Solve(Floats right, Integers order, Integers start, Integers below, Floats lower, Floats pivot,
                        Result solution) {
  const size_t V = from_last(right, 1), n = order.element_count(), columns = right.element_count() / V;
  if (start.element_count() != n + 1 || pivot.element_count() != n || lower.element_count() != below.element_count())
    return unfit();
  const int32_t *vertex = order.typed_data(), *begin = start.typed_data(), *row_of = below.typed_data();
  const float *__restrict factor = lower.typed_data(), *inverse = pivot.typed_data();
  std::memset(solution->typed_data(), 0, solution->size_bytes());
  std::vector<float> room(n * COLUMNS);
  float *__restrict x = room.data();
  for (size_t first = 0; first < columns; first += COLUMNS) {
    const size_t count = columns - first < COLUMNS ? columns - first : COLUMNS;
    size_t place[COLUMNS];
    for (size_t c = 0; c < count; c++) place[c] = (first + c) / 3 * 3 * V + (first + c) % 3;
    for (size_t j = 0; j < n; j++)
      for (size_t c = 0; c < count; c++) x[COLUMNS * j + c] = right.typed_data()[place[c] + 3 * (size_t)vertex[j]];
    for (size_t j = 0; j < n; j++) {
      float known[COLUMNS];
      std::memcpy(known, x + COLUMNS * j, sizeof known);
      for (int32_t p = begin[j]; p < begin[j + 1]; p++) {
        float *to = x + COLUMNS * (size_t)row_of[p];
        for (size_t c = 0; c < COLUMNS; c++) to[c] -= factor[p] * known[c];
      }
    }
    for (size_t j = n; j-- > 0;) {
      float sum[COLUMNS];
      for (size_t c = 0; c < COLUMNS; c++) sum[c] = inverse[j] * x[COLUMNS * j + c];
      for (int32_t p = begin[j]; p < begin[j + 1]; p++) {
        const float *from = x + COLUMNS * (size_t)row_of[p];
        for (size_t c = 0; c < COLUMNS; c++) sum[c] -= factor[p] * from[c];
      }
      std::memcpy(x + COLUMNS * j, sum, sizeof sum);
    }
    for (size_t j = 0; j < n; j++)
      for (size_t c = 0; c < count; c++) solution->typed_data()[place[c] + 3 * (size_t)vertex[j]] = x[COLUMNS * j + c];
  }
  return ffi::Error::Success();
}

// The blend shapes of [K][N] from one on; past the last, the last again.
struct Several {
  const float *shape[TOGETHER];
  size_t count;
};

static inline Several several(const float *shapes, size_t N, size_t K, size_t k) {
  Several s;
  s.count = K - k < TOGETHER ? K - k : TOGETHER;
  for (size_t r = 0; r < TOGETHER; r++) s.shape[r] = shapes + N * (r < s.count ? k + r : K - 1);
  return s;
}

// Sums of blend shapes [K][N] by weights [...][K]: the shapes are read once for all of a batch.
static ffi::Error Blend(Floats weights, Floats shapes, Result sums) {
  const size_t K = from_last(weights, 0), N = from_last(shapes, 0), count = weights.element_count() / K;
  if (shapes.element_count() != K * N) return unfit();
  const float *w = weights.typed_data(), *d = shapes.typed_data();
  std::memset(sums->typed_data(), 0, sums->size_bytes());
  for (size_t begin = 0; begin < N; begin += CHUNK) {
    const size_t wide = N - begin < CHUNK ? N - begin : CHUNK;
    for (size_t k = 0; k < K; k += TOGETHER)
      for (size_t b = 0; b < count; b++) {
        float *__restrict to = sums->typed_data() + N * b + begin;
        const Several s = several(d + begin, N, K, k);
        float by[TOGETHER];
        for (size_t r = 0; r < TOGETHER; r++) by[r] = r < s.count ? w[K * b + k + r] : 0.0f;
        for (size_t n = 0; n < wide; n++) {
          float sum = to[n];
          for (size_t r = 0; r < TOGETHER; r++) sum += by[r] * s.shape[r][n];
          to[n] = sum;
        }
      }
  }
  return ffi::Error::Success();
}

typedef float Vector __attribute__((vector_size(WIDTH * sizeof(float))));

static inline Vector loaded(const float *from) {
  Vector all;
  std::memcpy(&all, from, sizeof all);
  return all;
}

// Its transpose: products of the blend shapes with cotangents [...][N].
static ffi::Error BlendBack(Floats cotangent, Floats shapes, Result products) {
  const size_t N = from_last(shapes, 0), K = from_last(shapes, 1), count = cotangent.element_count() / N;
  if (shapes.element_count() != K * N) return unfit();
  const float *d = shapes.typed_data();
  std::memset(products->typed_data(), 0, products->size_bytes());
  for (size_t begin = 0; begin < N; begin += CHUNK) {
    const size_t wide = N - begin < CHUNK ? N - begin : CHUNK, whole = wide / WIDTH * WIDTH;
    for (size_t k = 0; k < K; k += TOGETHER)
      for (size_t b = 0; b < count; b++) {
        const float *__restrict from = cotangent.typed_data() + N * b + begin;
        const Several s = several(d + begin, N, K, k);
        Vector sum[TOGETHER] = {};
        for (size_t n = 0; n < whole; n += WIDTH)
          for (size_t r = 0; r < TOGETHER; r++) sum[r] += loaded(s.shape[r] + n) * loaded(from + n);
        for (size_t r = 0; r < s.count; r++) {
          float total = 0.0f;
          for (size_t n = whole; n < wide; n++) total += s.shape[r][n] * from[n];
          for (size_t i = 0; i < WIDTH; i++) total += sum[r][i];
          products->typed_data()[K * b + k + r] += total;
        }
      }
  }
  return ffi::Error::Success();
}

static Point point(const float *rows, size_t index) {
  return {rows[3 * index], rows[3 * index + 1], rows[3 * index + 2]};
}

// The faces nearest to positions [V][3], of a body [B][3].
static ffi::Error NearestFace(Floats x, Floats body, Integers faces, Integers groups, Indices nearest) {
  const size_t V = from_last(x, 1), B = from_last(body, 1), count = nearest->element_count() / V;
  if (!fit(count, {{&x, 3 * V}, {&body, 3 * B}}) || !shared(faces) || !shared(groups)) return unfit();
  for (size_t b = 0; b < count; b++) {
    Boxes boxes(row(body, 3 * B, b), faces.typed_data(), groups.typed_data(), from_last(groups, 1),
                from_last(groups, 0));
    for (size_t v = 0; v < V; v++) nearest->typed_data()[V * b + v] = boxes.nearest(point(row(x, 3 * V, b), v));
  }
  return ffi::Error::Success();
}

// Likewise, searched for from two vertices [V] of the body each, in some strides.
static ffi::Error NearestFaceAround(Floats x, Floats body, Integers faces, Integers around, Integers first,
                                    Integers second, int32_t strides, Indices nearest) {
  const size_t V = from_last(x, 1), B = from_last(body, 1), count = nearest->element_count() / V;
  if (!fit(count, {{&x, 3 * V}, {&body, 3 * B}}) || !fit<Integers>(count, {{&first, V}, {&second, V}})) return unfit();
  if (!shared(faces) || !shared(around) || from_last(around, 1) != B) return unfit();
  for (size_t b = 0; b < count; b++) {
    const Fans fans(row(body, 3 * B, b), faces.typed_data(), around.typed_data(), B, from_last(around, 0));
    const int32_t *one = row(first, V, b), *other = row(second, V, b);
    for (size_t v = 0; v < V; v++)
      nearest->typed_data()[V * b + v] = fans.nearest(point(row(x, 3 * V, b), v), one[v], other[v], strides);
  }
  return ffi::Error::Success();
}

// clang-format off
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothStretching, Stretching, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>().Ret<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothBending, Bending, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Ret<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothEdgeCollision, EdgeCollision, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>()
    .Attr<float>("stiffness").Attr<float>("offset").Ret<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothRelax, Relax, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>()
    .Attr<int32_t>("steps").Attr<float>("momentum").Attr<float>("longest").Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothRelaxBack, RelaxBack, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>()
    .Attr<int32_t>("steps").Attr<float>("momentum").Attr<float>("longest").Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothSolve, Solve, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothNearestFace, NearestFace, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Integers>().Ret<Integers>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothNearestFaceAround, NearestFaceAround, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Integers>().Arg<Integers>()
    .Attr<int32_t>("strides").Ret<Integers>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothBlend, Blend, ffi::Ffi::Bind().Arg<Floats>().Arg<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothBlendBack, BlendBack, ffi::Ffi::Bind().Arg<Floats>().Arg<Floats>().Ret<Floats>());
