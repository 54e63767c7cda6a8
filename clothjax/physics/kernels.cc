// Energies and relaxation of cloth, sums of blend shapes, a sparse solve and searches, as functions that XLA calls: see
// kernels.py.
//
// Energies and relaxation have positions as rows [3][V]. Loops over elements first write the gradients at all corners,
// [3][k elements + 1]; then loops over vertices add up those of their own corners, which `place` [most][V] names. The
// last entry of a row is zero: it is named by vertices with fewer corners than others. So none of these loops scatters,
// and they become vectors.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <utility>
#include <vector>

#include "nearest.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;
using Result = ffi::ResultBuffer<ffi::F32>;
using Indices = ffi::ResultBuffer<ffi::S32>;

constexpr size_t BLOCK = 256;      // elements whose energies are computed before they are added up
constexpr size_t CHUNK = 1024;     // numbers of a blend shape that stay in the nearest cache
constexpr size_t TOGETHER = 4;     // blend shapes that are read together
constexpr size_t COLUMNS = 24;     // right-hand sides that are solved for together
constexpr float SLIVER = 1e-6f;    // twice the area, over a hinge's squared size, below which a face has no direction

struct Elements {
  size_t count, vertices, most;
  const int32_t *corner, *place;  // [k][count], [most][vertices]
};

struct Sheet {
  Elements faces;
  const float *inverse, *weight, *mu, *lam;  // [4][count], [count] of the others
};

struct Hinges {
  Elements hinges;
  const float *stiffness, *angle;  // [count]
};

// 1 / sqrt(x) of a positive x, by three steps of Newton: sqrtf may set errno, and keeps loops from being vectors.
static inline float inverse_root(float x) {
  int32_t bits;
  float y;
  std::memcpy(&bits, &x, sizeof bits);
  bits = 0x5f3759df - (bits >> 1);
  std::memcpy(&y, &bits, sizeof y);
  for (int i = 0; i < 3; i++) y *= 1.5f - 0.5f * x * y * y;
  return y;
}

// The arc tangent of y / x (Abramowitz and Stegun 4.4.49), without a branch.
static inline float arc(float y, float x) {
  const float a = std::fabs(x), b = std::fabs(y), more = a > b ? a : b, less = a > b ? b : a;
  const float q = more > 0.0f ? less / more : 0.0f, t = q * q;
  float angle = q * (1.0f + t * (-0.3333314528f + t * (0.1999355085f + t * (-0.1420889944f + t * (0.1065626393f +
                t * (-0.0752896400f + t * (0.0429096138f + t * (-0.0161657367f + t * 0.0028662257f))))))));
  angle = b > a ? 1.57079633f - angle : angle;
  angle = x < 0.0f ? 3.14159265f - angle : angle;
  return y < 0.0f ? -angle : angle;
}

// Adds up the gradients at the corners of each vertex, to [3][V].
static void assemble(const Elements &of, size_t wide, const float *__restrict corners, float *__restrict sum) {
  const size_t V = of.vertices;
  for (size_t c = 0; c < 3; c++)
    for (size_t begin = 0; begin < V; begin += BLOCK) {
      const size_t end = begin + BLOCK < V ? begin + BLOCK : V;
      float total[BLOCK] = {0};
      for (size_t k = 0; k < of.most; k++)
        for (size_t v = begin; v < end; v++) total[v - begin] += corners[c * wide + of.place[k * V + v]];
      std::memcpy(sum + c * V + begin, total, (end - begin) * sizeof(float));
    }
}

struct Columns {
  float ux, uy, uz, vx, vy, vz;
};

// The deformation gradient of a face, or its change where x, y and z move.
static inline Columns deformed(const float *x, const float *y, const float *z, int32_t p, int32_t q, int32_t r, float a,
                               float b, float c, float d) {
  const float lx = x[p] - x[r], ly = y[p] - y[r], lz = z[p] - z[r];
  const float mx = x[q] - x[r], my = y[q] - y[r], mz = z[q] - z[r];
  return {a * lx + c * mx, a * ly + c * my, a * lz + c * mz, b * lx + d * mx, b * ly + d * my, b * lz + d * mz};
}

// The gradient of a face at its corners: (p, q) is the first Piola-Kirchhoff stress, or its change.
static inline void to_corners(float *corners, size_t n, float a, float b, float c, float d, Columns stress) {
  const size_t wide = 3 * n + 1;
  const auto [px, py, pz, qx, qy, qz] = stress;
  const float gx = a * px + b * qx, gy = a * py + b * qy, gz = a * pz + b * qz;
  const float hx = c * px + d * qx, hy = c * py + d * qy, hz = c * pz + d * qz;
  corners[0] = gx, corners[n] = hx, corners[2 * n] = -gx - hx;
  corners[wide] = gy, corners[wide + n] = hy, corners[wide + 2 * n] = -gy - hy;
  corners[2 * wide] = gz, corners[2 * wide + n] = hz, corners[2 * wide + 2 * n] = -gz - hz;
}

// Saint Venant-Kirchhoff: its energy, and its gradient [3][V]; `corners` is room for 3 (3 faces + 1) numbers.
static double stretching(const Sheet &s, const float *__restrict x, float *__restrict corners, float *gradient) {
  const size_t n = s.faces.count, V = s.faces.vertices, wide = 3 * n + 1;
  const float *y = x + V, *z = y + V, *inverse = s.inverse, *weights = s.weight, *mus = s.mu, *lams = s.lam;
  const int32_t *first = s.faces.corner, *second = first + n, *third = second + n;
  double energy = 0.0;
  for (size_t begin = 0; begin < n; begin += BLOCK) {
    const size_t end = begin + BLOCK < n ? begin + BLOCK : n;
    float parts[BLOCK] = {0};
#pragma GCC ivdep
    for (size_t i = begin; i < end; i++) {
      const int32_t p = first[i], q = second[i], r = third[i];
      const float a = inverse[i], b = inverse[n + i], c = inverse[2 * n + i], d = inverse[3 * n + i];
      const auto [ux, uy, uz, vx, vy, vz] = deformed(x, y, z, p, q, r, a, b, c, d);
      const float along = 0.5f * (ux * ux + uy * uy + uz * uz - 1.0f), shear = 0.5f * (ux * vx + uy * vy + uz * vz);
      const float across = 0.5f * (vx * vx + vy * vy + vz * vz - 1.0f), trace = along + across;
      const float mu = mus[i], lam = lams[i], w = weights[i];
      parts[i - begin] =
          w * (mu * (along * along + 2.0f * shear * shear + across * across) + 0.5f * lam * trace * trace);
      const float s0 = w * (2.0f * mu * along + lam * trace), s1 = w * 2.0f * mu * shear;
      const float s2 = w * (2.0f * mu * across + lam * trace);
      const float px = s0 * ux + s1 * vx, py = s0 * uy + s1 * vy, pz = s0 * uz + s1 * vz;
      const float qx = s1 * ux + s2 * vx, qy = s1 * uy + s2 * vy, qz = s1 * uz + s2 * vz;
      to_corners(corners + i, n, a, b, c, d, {px, py, pz, qx, qy, qz});
    }
    for (float part : parts) energy += part;
  }
  for (size_t c = 0; c < 3; c++) corners[c * wide + 3 * n] = 0.0f;
  assemble(s.faces, wide, corners, gradient);
  return energy;
}

// The Hessian of the stretching energy times a move [3][V] of the vertices (energies.stretching_hessian_product).
static void stretching_along(const Sheet &s, const float *__restrict x, const float *__restrict move,
                             float *__restrict corners, float *product) {
  const size_t n = s.faces.count, V = s.faces.vertices, wide = 3 * n + 1;
  const float *y = x + V, *z = y + V, *e = move, *f = e + V, *g = f + V;
  const float *inverse = s.inverse, *weights = s.weight, *mus = s.mu, *lams = s.lam;
  const int32_t *first = s.faces.corner, *second = first + n, *third = second + n;
#pragma GCC ivdep
  for (size_t i = 0; i < n; i++) {
    const int32_t p = first[i], q = second[i], r = third[i];
    const float a = inverse[i], b = inverse[n + i], c = inverse[2 * n + i], d = inverse[3 * n + i];
    const auto [ux, uy, uz, vx, vy, vz] = deformed(x, y, z, p, q, r, a, b, c, d);
    const auto [dux, duy, duz, dvx, dvy, dvz] = deformed(e, f, g, p, q, r, a, b, c, d);
    const float along = 0.5f * (ux * ux + uy * uy + uz * uz - 1.0f), shear = 0.5f * (ux * vx + uy * vy + uz * vz);
    const float across = 0.5f * (vx * vx + vy * vy + vz * vz - 1.0f);
    const float d0 = ux * dux + uy * duy + uz * duz, d2 = vx * dvx + vy * dvy + vz * dvz;
    const float d1 = 0.5f * (ux * dvx + uy * dvy + uz * dvz + vx * dux + vy * duy + vz * duz);
    const float mu = 2.0f * mus[i], lam = lams[i], w = weights[i];
    const float s0 = w * (mu * along + lam * (along + across)), s1 = w * mu * shear;
    const float s2 = w * (mu * across + lam * (along + across));
    const float t0 = w * (mu * d0 + lam * (d0 + d2)), t1 = w * mu * d1, t2 = w * (mu * d2 + lam * (d0 + d2));
    const float px = s0 * dux + s1 * dvx + t0 * ux + t1 * vx, qx = s1 * dux + s2 * dvx + t1 * ux + t2 * vx;
    const float py = s0 * duy + s1 * dvy + t0 * uy + t1 * vy, qy = s1 * duy + s2 * dvy + t1 * uy + t2 * vy;
    const float pz = s0 * duz + s1 * dvz + t0 * uz + t1 * vz, qz = s1 * duz + s2 * dvz + t1 * uz + t2 * vz;
    to_corners(corners + i, n, a, b, c, d, {px, py, pz, qx, qy, qz});
  }
  for (size_t c = 0; c < 3; c++) corners[c * wide + 3 * n] = 0.0f;
  assemble(s.faces, wide, corners, product);
}

// The dihedral energy (energies.bending), with k / (8 A) as stiffness; `corners` is room for 3 (4 hinges + 1) numbers.
static double bending(const Hinges &h, const float *__restrict x, float *__restrict corners, float *gradient) {
  const size_t n = h.hinges.count, V = h.hinges.vertices, wide = 4 * n + 1;
  const float *y = x + V, *z = y + V, *stiffness = h.stiffness, *rest = h.angle;
  const int32_t *start = h.hinges.corner, *stop = start + n, *left = stop + n, *right = left + n;
  double energy = 0.0;
  for (size_t begin = 0; begin < n; begin += BLOCK) {
    const size_t end = begin + BLOCK < n ? begin + BLOCK : n;
    float parts[BLOCK] = {0};
#pragma GCC ivdep
    for (size_t i = begin; i < end; i++) {
      const int32_t p = start[i], q = stop[i], r = left[i], t = right[i];
      const float ex = x[q] - x[p], ey = y[q] - y[p], ez = z[q] - z[p];
      const float lx = x[r] - x[p], ly = y[r] - y[p], lz = z[r] - z[p];
      const float rx = x[t] - x[p], ry = y[t] - y[p], rz = z[t] - z[p];
      const float nx = ey * lz - ez * ly, ny = ez * lx - ex * lz, nz = ex * ly - ey * lx;
      const float ox = ry * ez - rz * ey, oy = rz * ex - rx * ez, oz = rx * ey - ry * ex;
      const float sine = (ny * oz - nz * oy) * ex + (nz * ox - nx * oz) * ey + (nx * oy - ny * ox) * ez;
      const float cosine = nx * ox + ny * oy + nz * oz, edge = ex * ex + ey * ey + ez * ez;
      const float ll = lx * lx + ly * ly + lz * lz, rr = rx * rx + ry * ry + rz * rz;
      const float longest = edge > ll ? edge : ll, size = longest > rr ? longest : rr;
      float ee = edge, nn = nx * nx + ny * ny + nz * nz, oo = ox * ox + oy * oy + oz * oz;
      const float bent = (nn < oo ? nn : oo) > SLIVER * SLIVER * size * size ? 1.0f : 0.0f;
      ee += 1.0f - bent, nn += 1.0f - bent, oo += 1.0f - bent;  // where it is flat they are nearly zero
      const float length = ee * inverse_root(ee), angle = bent * arc(sine, cosine * length) - rest[i];
      const float w = 2.0f * stiffness[i], torque = bent * w * ee * angle * length, longer = w * angle * angle;
      parts[i - begin] = stiffness[i] * edge * angle * angle;
      const float u = -torque / nn, v = -torque / oo;
      const float a = u * (lx * ex + ly * ey + lz * ez) / ee, b = v * (rx * ex + ry * ey + rz * ez) / ee;
      const float sx = a * nx + b * ox - longer * ex, sy = a * ny + b * oy - longer * ey;
      const float sz = a * nz + b * oz - longer * ez;
      float *gx = corners + i, *gy = gx + wide, *gz = gy + wide;
      gx[0] = sx - u * nx - v * ox, gx[n] = -sx, gx[2 * n] = u * nx, gx[3 * n] = v * ox;
      gy[0] = sy - u * ny - v * oy, gy[n] = -sy, gy[2 * n] = u * ny, gy[3 * n] = v * oy;
      gz[0] = sz - u * nz - v * oz, gz[n] = -sz, gz[2 * n] = u * nz, gz[3 * n] = v * oz;
    }
    for (float part : parts) energy += part;
  }
  for (size_t c = 0; c < 3; c++) corners[c * wide + 4 * n] = 0.0f;
  assemble(h.hinges, wide, corners, gradient);
  return energy;
}

// The energy of edges in the body (incremental_potential.edge_collision), of planes [3][count] at places between the
// ends.
static double edge_collision(const Elements &edges, const float *__restrict place, const float *__restrict point,
                             const float *__restrict normal, float stiffness, float offset, const float *__restrict x,
                             float *__restrict corners, float *gradient) {
  const size_t n = edges.count, V = edges.vertices, wide = 2 * n + 1;
  const float *y = x + V, *z = y + V;
  const int32_t *start = edges.corner, *stop = start + n;
  double energy = 0.0;
  for (size_t begin = 0; begin < n; begin += BLOCK) {
    const size_t end = begin + BLOCK < n ? begin + BLOCK : n;
    float parts[BLOCK] = {0};
#pragma GCC ivdep
    for (size_t i = begin; i < end; i++) {
      const int32_t p = start[i], q = stop[i];
      const float t = place[i], nx = normal[i], ny = normal[n + i], nz = normal[2 * n + i];
      const float dx = x[p] - point[i] + t * (x[q] - x[p]), dy = y[p] - point[n + i] + t * (y[q] - y[p]);
      const float dz = z[p] - point[2 * n + i] + t * (z[q] - z[p]);
      const float inside = offset - (dx * nx + dy * ny + dz * nz), depth = inside > 0.0f ? inside : 0.0f;
      parts[i - begin] = stiffness * depth * depth * depth;
      const float force = -3.0f * stiffness * depth * depth, gx = force * nx, gy = force * ny, gz = force * nz;
      corners[i] = (1.0f - t) * gx, corners[n + i] = t * gx;
      corners[wide + i] = (1.0f - t) * gy, corners[wide + n + i] = t * gy;
      corners[2 * wide + i] = (1.0f - t) * gz, corners[2 * wide + n + i] = t * gz;
    }
    for (float part : parts) energy += part;
  }
  for (size_t c = 0; c < 3; c++) corners[c * wide + 2 * n] = 0.0f;
  assemble(edges, wide, corners, gradient);
  return energy;
}

// Of a step of relaxation.relaxed.
struct Relaxing {
  const float *mobility;
  float momentum, longest;
};

// The move m = -(1 + momentum) mobility gradient, of which m / sqrt(1 + |m|^2 / longest^2) is taken.
static void relax(const Sheet &s, const Relaxing &by, const float *__restrict x, float *corners, float *__restrict g,
                  float *__restrict next) {
  const size_t V = s.faces.vertices;
  const float square = 1.0f / (by.longest * by.longest), further = -(1.0f + by.momentum);
  stretching(s, x, corners, g);
  for (size_t v = 0; v < V; v++) {
    const float m = further * by.mobility[v], a = m * g[v], b = m * g[V + v], c = m * g[2 * V + v];
    const float share = inverse_root(1.0f + (a * a + b * b + c * c) * square);
    next[v] = x[v] + share * a, next[V + v] = x[V + v] + share * b, next[2 * V + v] = x[2 * V + v] + share * c;
  }
}

// Its transpose at x: adds H M by to `to`, with the derivative M of the move by the gradient; both are symmetric.
static void relax_back(const Sheet &s, const Relaxing &of, const float *__restrict x, float *corners,
                       float *__restrict g, float *__restrict pushed, const float *__restrict by,
                       float *__restrict to) {
  const size_t V = s.faces.vertices;
  const float square = 1.0f / (of.longest * of.longest), further = -(1.0f + of.momentum);
  stretching(s, x, corners, g);
  for (size_t v = 0; v < V; v++) {
    const float m = further * of.mobility[v], a = m * g[v], b = m * g[V + v], c = m * g[2 * V + v];
    const float share = inverse_root(1.0f + (a * a + b * b + c * c) * square);
    const float along = (a * by[v] + b * by[V + v] + c * by[2 * V + v]) * square * share * share;
    pushed[v] = m * share * (by[v] - along * a), pushed[V + v] = m * share * (by[V + v] - along * b);
    pushed[2 * V + v] = m * share * (by[2 * V + v] - along * c);
  }
  stretching_along(s, x, pushed, corners, g);
  for (size_t v = 0; v < 3 * V; v++) to[v] += g[v];
}

// The garments of a batch that one jax.vmap made. An operand that they share has an axis of 1, or none.
template <typename Buffer>
static auto row(const Buffer &of, size_t length, size_t index) {
  return of.typed_data() + (of.element_count() == length ? 0 : index * length);
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

static Elements elements(const Integers &corner, const Integers &place) {
  return {from_last(corner, 0), from_last(place, 0), from_last(place, 1), corner.typed_data(), place.typed_data()};
}

static Sheet sheet(const Elements &of, const Floats &inverse, const Floats &weight, const Floats &mu, const Floats &lam,
                   size_t b) {
  const size_t n = of.count;
  return {of, row(inverse, 4 * n, b), row(weight, n, b), row(mu, n, b), row(lam, n, b)};
}

static ffi::Error Stretching(Floats x, Integers corner, Integers place, Floats inverse, Floats weight, Floats mu,
                             Floats lam, Result energy, Result gradient) {
  const Elements faces = elements(corner, place);
  const size_t size = 3 * faces.vertices, n = faces.count, count = energy->element_count();
  if (!fit(count, {{&x, size}, {&inverse, 4 * n}, {&weight, n}, {&mu, n}, {&lam, n}})) return unfit();
  std::vector<float> corners(3 * (3 * n + 1));
  for (size_t b = 0; b < count; b++)
    energy->typed_data()[b] =
        (float)stretching(sheet(faces, inverse, weight, mu, lam, b), row(x, size, b), corners.data(),
                          gradient->typed_data() + size * b);
  return ffi::Error::Success();
}

static ffi::Error Bending(Floats x, Integers corner, Integers place, Floats stiffness, Floats angle, Result energy,
                          Result gradient) {
  const Elements hinges = elements(corner, place);
  const size_t size = 3 * hinges.vertices, n = hinges.count, count = energy->element_count();
  if (!fit(count, {{&x, size}, {&stiffness, n}, {&angle, n}})) return unfit();
  std::vector<float> corners(3 * (4 * n + 1));
  for (size_t b = 0; b < count; b++)
    energy->typed_data()[b] = (float)bending({hinges, row(stiffness, n, b), row(angle, n, b)}, row(x, size, b),
                                             corners.data(), gradient->typed_data() + size * b);
  return ffi::Error::Success();
}

static ffi::Error EdgeCollision(Floats x, Integers corner, Integers place, Floats share, Floats point, Floats normal,
                                float stiffness, float offset, Result energy, Result gradient) {
  const Elements edges = elements(corner, place);
  const size_t size = 3 * edges.vertices, n = edges.count, count = energy->element_count();
  if (!fit(count, {{&x, size}, {&share, n}, {&point, 3 * n}, {&normal, 3 * n}})) return unfit();
  std::vector<float> corners(3 * (2 * n + 1));
  for (size_t b = 0; b < count; b++)
    energy->typed_data()[b] = (float)edge_collision(
        edges, row(share, n, b), row(point, 3 * n, b), row(normal, 3 * n, b), stiffness, offset, row(x, size, b),
        corners.data(), gradient->typed_data() + size * b);
  return ffi::Error::Success();
}

static ffi::Error Relax(Floats x, Floats mobility, Integers corner, Integers place, Floats inverse, Floats weight,
                        Floats mu, Floats lam, int32_t steps, float momentum, float longest, Result after) {
  const Elements faces = elements(corner, place);
  const size_t V = faces.vertices, n = faces.count, count = after->element_count() / (3 * V * steps);
  if (!fit(count, {{&x, 3 * V}, {&mobility, V}, {&inverse, 4 * n}, {&weight, n}, {&mu, n}, {&lam, n}})) return unfit();
  std::vector<float> corners(3 * (3 * n + 1)), g(3 * V);
  for (size_t b = 0; b < count; b++) {
    const Sheet s = sheet(faces, inverse, weight, mu, lam, b);
    const Relaxing by = {row(mobility, V, b), momentum, longest};
    const float *from = row(x, 3 * V, b), *before = from;
    for (int32_t i = 0; i < steps; i++) {
      float *to = after->typed_data() + 3 * V * (steps * b + i);
      relax(s, by, from, corners.data(), g.data(), to);
      for (size_t v = 0; v < 3 * V; v++) to[v] += momentum * (from[v] - before[v]);
      before = from, from = to;
    }
  }
  return ffi::Error::Success();
}

static ffi::Error RelaxBack(Floats cotangent, Floats x, Floats after, Floats mobility, Integers corner, Integers place,
                            Floats inverse, Floats weight, Floats mu, Floats lam, int32_t steps, float momentum,
                            float longest, Result by) {
  const Elements faces = elements(corner, place);
  const size_t V = faces.vertices, n = faces.count, count = by->element_count() / (3 * V);
  if (!fit(count, {{&cotangent, 3 * V}, {&x, 3 * V}, {&after, 3 * V * steps}, {&mobility, V}, {&inverse, 4 * n},
                   {&weight, n}, {&mu, n}, {&lam, n}}))
    return unfit();
  std::vector<float> corners(3 * (3 * n + 1)), g(3 * V), pushed(3 * V), later(3 * V), held(3 * V);
  for (size_t b = 0; b < count; b++) {
    const Sheet s = sheet(faces, inverse, weight, mu, lam, b);
    const float *passed = row(after, 3 * V * steps, b);
    const Relaxing of = {row(mobility, V, b), momentum, longest};
    float *to = by->typed_data() + 3 * V * b;
    std::memcpy(to, row(cotangent, 3 * V, b), 3 * V * sizeof(float));
    held.assign(3 * V, 0.0f);
    for (int32_t i = steps - 1; i >= 0; i--) {
      // `to` is by the positions after step i; those before it also took part in step i + 1, by `held`
      const float *at = i ? passed + 3 * V * (i - 1) : row(x, 3 * V, b);
      std::memcpy(later.data(), to, 3 * V * sizeof(float));
      relax_back(s, of, at, corners.data(), g.data(), pushed.data(), later.data(), to);
      for (size_t v = 0; v < 3 * V; v++) {
        to[v] += held[v] + (i ? momentum * later[v] : 0.0f);  // the first step has none before it
        held[v] = -momentum * later[v];
      }
    }
  }
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
    .Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>().Arg<Floats>()
    .Ret<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothBending, Bending, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Ret<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothEdgeCollision, EdgeCollision, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>()
    .Attr<float>("stiffness").Attr<float>("offset").Ret<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothRelax, Relax, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Arg<Floats>()
    .Arg<Floats>().Attr<int32_t>("steps").Attr<float>("momentum")
    .Attr<float>("longest").Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothRelaxBack, RelaxBack, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Floats>()
    .Arg<Floats>().Arg<Floats>().Arg<Floats>().Attr<int32_t>("steps").Attr<float>("momentum")
    .Attr<float>("longest").Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothSolve, Solve, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Integers>().Arg<Floats>().Arg<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothNearestFace, NearestFace, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Integers>().Ret<Integers>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothNearestFaceAround, NearestFaceAround, ffi::Ffi::Bind()
    .Arg<Floats>().Arg<Floats>().Arg<Integers>().Arg<Integers>().Arg<Integers>().Arg<Integers>()
    .Attr<int32_t>("strides").Ret<Integers>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothBlend, Blend, ffi::Ffi::Bind().Arg<Floats>().Arg<Floats>().Ret<Floats>());
XLA_FFI_DEFINE_HANDLER_SYMBOL(ClothBlendBack, BlendBack, ffi::Ffi::Bind().Arg<Floats>().Arg<Floats>().Ret<Floats>());
