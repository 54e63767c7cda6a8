// The nearest triangles of a mesh: see geometry/proximity.py, whose nearest_face and nearest_face_around these are.
//
// Triangles are kept in rows of WIDTH, one coordinate after the other, so that the loops over a row become vectors.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

constexpr size_t WIDTH = 16;  // numbers of a vector; triangles of a row

struct Row {
  float at[9][WIDTH];  // the first corner, and the other two from there
  int32_t face[WIDTH];
};

struct Point {
  float x, y, z;
};

// The point of the triangle (0, b, c) nearest to p is v b + w c. Returns its squared distance (proximity._closest).
static inline float closest(Point b, Point c, Point p, float *at_v, float *at_w) {
  const float bb = b.x * b.x + b.y * b.y + b.z * b.z, bc = b.x * c.x + b.y * c.y + b.z * c.z;
  const float cc = c.x * c.x + c.y * c.y + c.z * c.z, bp = b.x * p.x + b.y * p.y + b.z * p.z;
  const float cp = c.x * p.x + c.y * p.y + c.z * p.z;
  const float nx = b.y * c.z - b.z * c.y, ny = b.z * c.x - b.x * c.z, nz = b.x * c.y - b.y * c.x;
  const float squared = nx * nx + ny * ny + nz * nz, safe = squared > 0.0f ? squared : 1.0f;
  const float v = ((p.y * c.z - p.z * c.y) * nx + (p.z * c.x - p.x * c.z) * ny + (p.x * c.y - p.y * c.x) * nz) / safe;
  const float w = ((b.y * p.z - b.z * p.y) * nx + (b.z * p.x - b.x * p.z) * ny + (b.x * p.y - b.y * p.x) * nz) / safe;
  const float slope = bb - 2.0f * bc + cc;
  float t = bp / (bb > 0.0f ? bb : 1.0f), u = cp / (cc > 0.0f ? cc : 1.0f);
  float s = (cp - bp + bb - bc) / (slope > 0.0f ? slope : 1.0f);
  t = t > 0.0f ? t : 0.0f, t = t < 1.0f ? t : 1.0f;
  u = u > 0.0f ? u : 0.0f, u = u < 1.0f ? u : 1.0f;
  s = s > 0.0f ? s : 0.0f, s = s < 1.0f ? s : 1.0f;
  const auto apart = [&](float v, float w) {  // not by products: they cancel near the triangle
    const float x = p.x - v * b.x - w * c.x, y = p.y - v * b.y - w * c.y, z = p.z - v * b.z - w * c.z;
    return x * x + y * y + z * z;
  };
  const float inner = apart(v, w), first = apart(t, 0.0f), second = apart(0.0f, u), third = apart(1.0f - s, s);
  const bool inside = (squared > 0.0f) & (v >= 0.0f) & (w >= 0.0f) & (v + w <= 1.0f);
  float best = inside ? inner : std::numeric_limits<float>::infinity(), best_v = v, best_w = w;
  best_v = first < best ? t : best_v, best_w = first < best ? 0.0f : best_w, best = first < best ? first : best;
  best_v = second < best ? 0.0f : best_v, best_w = second < best ? u : best_w, best = second < best ? second : best;
  best_v = third < best ? 1.0f - s : best_v, best_w = third < best ? s : best_w, best = third < best ? third : best;
  *at_v = best_v, *at_w = best_w;
  return best;
}

static inline Point corner(const float *body, const int32_t *faces, int32_t face, size_t k) {
  const float *at = body + 3 * (size_t)faces[3 * (size_t)face + k];
  return {at[0], at[1], at[2]};
}

static void fill(Row &row, size_t place, const float *body, const int32_t *faces, int32_t face) {
  const Point a = corner(body, faces, face, 0), b = corner(body, faces, face, 1), c = corner(body, faces, face, 2);
  const float all[9] = {a.x, a.y, a.z, b.x - a.x, b.y - a.y, b.z - a.z, c.x - a.x, c.y - a.y, c.z - a.z};
  for (size_t i = 0; i < 9; i++) row.at[i][place] = all[i];
  row.face[place] = face;
}

// The nearest so far.
struct Nearest {
  float squared = std::numeric_limits<float>::infinity();
  int32_t face = 0;

  void among(const Row &row, Point p) {
    float apart[WIDTH], least[WIDTH];
#pragma GCC ivdep
    for (size_t i = 0; i < WIDTH; i++) {
      float v, w;
      const Point b{row.at[3][i], row.at[4][i], row.at[5][i]}, c{row.at[6][i], row.at[7][i], row.at[8][i]};
      apart[i] = closest(b, c, {p.x - row.at[0][i], p.y - row.at[1][i], p.z - row.at[2][i]}, &v, &w);
    }
    for (size_t i = 0; i < WIDTH; i++) least[i] = apart[i];
    for (size_t half = WIDTH / 2; half; half /= 2)
      for (size_t i = 0; i < half; i++) least[i] = least[i + half] < least[i] ? least[i + half] : least[i];
    if (!(least[0] < squared)) return;
    squared = least[0];
    size_t place = 0;
    while (place < WIDTH - 1 && apart[place] != squared) place++;
    face = row.face[place];
  }
};

// A mesh of `groups` [count][size] of neighbouring faces, in boxes.
class Boxes {
 public:
  Boxes(const float *body, const int32_t *faces, const int32_t *groups, size_t count, size_t size)
      : count_((count + WIDTH - 1) / WIDTH * WIDTH),
        rows_((size + WIDTH - 1) / WIDTH),
        table_(count_ * rows_),
        box_(6 * count_, std::numeric_limits<float>::infinity()),
        away_(count_) {
    for (size_t g = 0; g < count; g++) {
      for (size_t i = 0; i < rows_ * WIDTH; i++)
        fill(table_[g * rows_ + i / WIDTH], i % WIDTH, body, faces, groups[g * size + (i < size ? i : size - 1)]);
      for (size_t axis = 0; axis < 3; axis++) {
        float low = std::numeric_limits<float>::infinity(), high = -low;
        for (size_t i = 0; i < size; i++)
          for (size_t k = 0; k < 3; k++) {
            const float at = body[3 * (size_t)faces[3 * (size_t)groups[g * size + i] + k] + axis];
            low = at < low ? at : low, high = at > high ? at : high;
          }
        box_[2 * axis * count_ + g] = low, box_[(2 * axis + 1) * count_ + g] = -high;
      }
    }
  }

  // Groups in the order of the distance to their boxes, until the next box is farther than the nearest triangle so far.
  int32_t nearest(Point p) {
    if (!std::isfinite(p.x + p.y + p.z)) return 0;
    const float place[3] = {p.x, p.y, p.z};
    float *__restrict away = away_.data();
    for (size_t g = 0; g < count_; g++) away[g] = 0.0f;
    for (size_t axis = 0; axis < 3; axis++) {
      const float *low = box_.data() + 2 * axis * count_, *minus_high = low + count_;
      for (size_t g = 0; g < count_; g++) {
        const float below = low[g] - place[axis], above = place[axis] + minus_high[g];
        const float outside = below > above ? below : above, beyond = outside > 0.0f ? outside : 0.0f;
        away[g] += beyond * beyond;
      }
    }
    Nearest best;
    while (true) {
      float least[WIDTH];
      for (size_t i = 0; i < WIDTH; i++) least[i] = away[i];
      for (size_t g = WIDTH; g < count_; g += WIDTH)
        for (size_t i = 0; i < WIDTH; i++) least[i] = away[g + i] < least[i] ? away[g + i] : least[i];
      for (size_t half = WIDTH / 2; half; half /= 2)
        for (size_t i = 0; i < half; i++) least[i] = least[i + half] < least[i] ? least[i + half] : least[i];
      if (!(least[0] < best.squared)) return best.face;
      size_t next = 0;
      while (away[next] != least[0]) next++;
      away[next] = std::numeric_limits<float>::infinity();
      for (size_t row = 0; row < rows_; row++) best.among(table_[next * rows_ + row], p);
    }
  }

 private:
  size_t count_, rows_;
  std::vector<Row> table_;
  std::vector<float> box_, away_;  // [low, -high of x, y, z][groups], and the squared distances to these
};

// A mesh with the faces `around` [vertices][most] each vertex.
class Fans {
 public:
  Fans(const float *body, const int32_t *faces, const int32_t *around, size_t vertices, size_t most)
      : body_(body), faces_(faces), rows_((most + WIDTH - 1) / WIDTH), table_(vertices * rows_) {
    for (size_t v = 0; v < vertices; v++)
      for (size_t i = 0; i < rows_ * WIDTH; i++)
        fill(table_[v * rows_ + i / WIDTH], i % WIDTH, body, faces, around[v * most + (i < most ? i : most - 1)]);
  }

  // Those around the first vertices, then those around the nearest corner of the best face, in each of some strides.
  int32_t nearest(Point p, int32_t first, int32_t second, int32_t strides) const {
    Nearest best;
    int32_t last = first;
    among(best, first, p);
    if (second != first) among(best, second, p), last = second;
    for (int32_t stride = 0; stride < strides; stride++) {
      const Point a = corner(body_, faces_, best.face, 0), b = corner(body_, faces_, best.face, 1);
      const Point c = corner(body_, faces_, best.face, 2);
      float v, w;
      closest({b.x - a.x, b.y - a.y, b.z - a.z}, {c.x - a.x, c.y - a.y, c.z - a.z}, {p.x - a.x, p.y - a.y, p.z - a.z},
              &v, &w);
      const float u = 1.0f - v - w;
      const int32_t next = faces_[3 * (size_t)best.face + (v > u ? (w > v ? 2 : 1) : (w > u ? 2 : 0))];
      if (next == first || next == second || next == last) break;  // nothing new is there
      among(best, next, p), last = next;
    }
    return best.face;
  }

 private:
  void among(Nearest &best, int32_t vertex, Point p) const {
    for (size_t row = 0; row < rows_; row++) best.among(table_[(size_t)vertex * rows_ + row], p);
  }

  const float *body_;
  const int32_t *faces_;
  size_t rows_;
  std::vector<Row> table_;
};
