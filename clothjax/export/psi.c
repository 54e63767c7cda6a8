/* See psi.h. The frame is that of clothjax/runtime/inference.py, the file that of clothjax/export/native.py. */
#include "psi.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define ALIGN 64          /* bytes, of all arrays */
#define FARTHEST 1e6f     /* m from the origin */
#define MOST_JOINTS 1024
#define MOST_WIDTH 65536  /* inputs of a layer: their sums have room in 32 bits */
#define MOST_HIDDEN 16
#define LANES 64          /* vertices that are skinned at once */
#define LEAST 1e-30f      /* inputs of a layer that are smaller than this are nothing */

typedef struct { /* y = bias + scale * (weights (gain * x)); without inputs the bias alone */
    int32_t inputs, outputs, stride;
    const float *gain, *bias, *scale;
    const int8_t *weights; /* [outputs][stride] */
} layer;

typedef struct {
    const float *low, *high, *slack;
} bounds;

struct psi_model {
    void *file;
    int32_t joints, kept, moving, vertices, code, hidden, decoder, skip, relu, mixed, known;
    float fps, decay;
    const int32_t *parent, *input, *bone;
    const float *weight, *rest, *pose_mean, *start; /* weight [moving][vertices, to a multiple of LANES] */
    bounds pose_bounds, code_bounds;
    layer pose, previous, then[MOST_HIDDEN], read, decode[MOST_HIDDEN], mix, shapes;
    int32_t widest, longest;  /* of what layers give and of what they take */
};

struct psi_state {
    void *memory;
    float *latent, *next;
    float *rotations, *positions, *translation;  /* [3][joints][9], [3][joints][3], [3][3], newest first */
    float *global, *skinning;                    /* rotations [joints][9]; matrices [moving][12] */
    float *inputs, *rows[3];
    int16_t *fixed; /* inputs of a layer in fixed point */
};

/* reading */

typedef struct {
    const uint8_t *bytes;
    size_t left;
    int sound;
} reader;

static const void *take(reader *r, size_t count, size_t size) {
    static const int32_t nothing[1];
    size_t bytes = (count * size + ALIGN - 1) / ALIGN * ALIGN;
    const void *at = r->bytes;
    if (!r->sound || count > r->left / size || bytes > r->left) {
        r->sound = 0;
        return nothing;
    }
    r->bytes += bytes;
    r->left -= bytes;
    return at;
}

static const float *floats(reader *r, size_t count) { return take(r, count, sizeof(float)); }
static const int32_t *integers(reader *r, size_t count) { return take(r, count, sizeof(int32_t)); }

static int32_t within(reader *r, int32_t value, int32_t low, int32_t high) {
    if (value < low || value > high) {
        r->sound = 0;
        return low;
    }
    return value;
}

static const int32_t *indices(reader *r, int32_t count, int32_t end) {
    const int32_t *at = integers(r, count);
    for (int32_t i = 0; r->sound && i < count; i++) within(r, at[i], 0, end - 1);
    return at;
}

static layer read_layer(reader *r, psi_model *m) {
    layer l = {0};
    const int32_t *size = integers(r, 2);
    l.inputs = within(r, r->sound ? size[0] : 0, 0, MOST_WIDTH);
    l.outputs = within(r, r->sound ? size[1] : 0, 0, INT32_MAX / 4);
    l.stride = (l.inputs + ALIGN - 1) / ALIGN * ALIGN;
    l.gain = floats(r, l.inputs);
    l.bias = floats(r, l.outputs);
    l.scale = floats(r, l.outputs);
    l.weights = take(r, (size_t)l.outputs * l.stride, 1);
    if (l.outputs > m->widest) m->widest = l.outputs;
    if (l.stride > m->longest) m->longest = l.stride;
    return l;
}

static bounds read_bounds(reader *r, int32_t count) {
    bounds b;
    b.low = floats(r, count);
    b.high = floats(r, count);
    b.slack = floats(r, count);
    return b;
}

/* Whether every layer takes what there is for it. */
static int fits(const psi_model *m) {
    int32_t width = m->pose.outputs, wide = m->decoder ? m->decode[0].inputs : 0, shapes;
    int good = m->hidden > 0 && m->decoder > 0 && m->pose.inputs == 6 + 18 * m->kept + 9 * (m->kept - 1);
    good &= m->previous.outputs == width && (m->previous.inputs ? m->previous.inputs == m->code : width <= m->code);
    for (int32_t i = 0; i < m->hidden; i++) {
        good &= m->then[i].inputs == width;
        width = m->then[i].outputs;
    }
    good &= width == m->code && (m->read.inputs ? m->read.inputs == m->code : m->read.outputs <= m->code);
    width = wide;
    for (int32_t i = 0; i < m->decoder; i++) {
        good &= m->decode[i].inputs == width;
        width = m->decode[i].outputs;
    }
    good &= m->read.outputs == wide + (m->skip ? width : 0);
    shapes = m->mixed ? m->mix.outputs : width;
    return good && (!m->mixed || m->mix.inputs == width) && m->shapes.inputs == shapes &&
           m->shapes.outputs == 3 * m->vertices;
}

static void read_model(reader *r, psi_model *m) {
    const int32_t *head = integers(r, 16);
    const float *rates = floats(r, 2);
    if (!r->sound) return;
    m->joints = within(r, head[2], 1, MOST_JOINTS);
    m->kept = within(r, head[3], 1, m->joints);
    m->moving = within(r, head[4], 1, m->joints);
    m->vertices = within(r, head[5], 1, INT32_MAX / 16);
    m->code = within(r, head[6], 1, MOST_WIDTH);
    m->hidden = within(r, head[7], 1, MOST_HIDDEN);
    m->decoder = within(r, head[8], 1, MOST_HIDDEN);
    m->skip = head[9], m->relu = head[10], m->mixed = head[11], m->known = head[12];
    m->fps = rates[0], m->decay = rates[1];
    m->parent = integers(r, m->joints);
    for (int32_t j = 0; r->sound && j < m->joints; j++) within(r, m->parent[j], j ? 0 : -1, j - 1);
    m->input = indices(r, m->kept, m->joints);
    m->bone = indices(r, m->moving, m->joints);
    m->rest = floats(r, 3 * (size_t)m->joints);
    m->weight = floats(r, (size_t)m->moving * ((m->vertices + LANES - 1) / LANES * LANES));
    int32_t poses = 6 + 18 * m->kept + 9 * (m->kept - 1);
    m->pose_mean = floats(r, poses);
    m->pose_bounds = read_bounds(r, poses);
    m->code_bounds = read_bounds(r, m->code);
    m->start = floats(r, m->code);
    m->pose = read_layer(r, m);
    m->previous = read_layer(r, m);
    for (int32_t i = 0; i < m->hidden; i++) m->then[i] = read_layer(r, m);
    m->read = read_layer(r, m);
    for (int32_t i = 0; i < m->decoder; i++) m->decode[i] = read_layer(r, m);
    if (m->mixed) m->mix = read_layer(r, m);
    m->shapes = read_layer(r, m);
}

static uint8_t *aligned(void *memory) {
    return (uint8_t *)(((uintptr_t)memory + ALIGN - 1) / ALIGN * ALIGN);
}

static psi_model *failed(psi_model *m, const char **error, const char *why) {
    if (error) *error = why;
    psi_free(m);
    return NULL;
}

static psi_model *parse(psi_model *m, const void *bytes, size_t size, const char **error) {
    const int32_t version[2] = {0x00495350, 1}; /* "PSI" */
    if (size < ALIGN || memcmp(bytes, version, sizeof version)) return failed(m, error, "not a .psi of this version");
    reader r = {bytes, size, 1};
    read_model(&r, m);
    if (!r.sound || r.left || !fits(m)) return failed(m, error, "a damaged .psi: convert it again");
    return m;
}

psi_model *psi_open(const void *bytes, size_t size, const char **error) {
    psi_model *m = calloc(1, sizeof *m);
    if (!m) return failed(m, error, "no memory");
    if ((uintptr_t)bytes % sizeof(float)) return failed(m, error, "not at a multiple of 4");
    return parse(m, bytes, size, error);
}

psi_model *psi_load(const char *path, const char **error) {
    FILE *file = fopen(path, "rb");
    psi_model *m = calloc(1, sizeof *m);
    if (!file || !m) {
        if (file) fclose(file);
        return failed(m, error, file ? "no memory" : "the file cannot be opened");
    }
    long size = fseek(file, 0, SEEK_END) ? -1 : ftell(file);
    rewind(file);
    m->file = size < ALIGN ? NULL : malloc((size_t)size + ALIGN);
    uint8_t *bytes = m->file ? aligned(m->file) : NULL;
    size_t got = bytes ? fread(bytes, 1, size, file) : 0;
    fclose(file);
    if (size < ALIGN || got != (size_t)size) return failed(m, error, "the file cannot be read");
    return parse(m, bytes, (size_t)size, error);
}

void psi_free(psi_model *m) {
    if (m) free(m->file);
    free(m);
}

int psi_joints(const psi_model *m) { return m->joints; }
int psi_vertices(const psi_model *m) { return m->vertices; }
float psi_fps(const psi_model *m) { return m->fps; }

/* the frame */

/* The largest of |gain x|. */
static float largest(const float *x, const float *gain, int32_t count) {
    int32_t most = 0; /* the bits of positive floats are in their order */
    float value;
    for (int32_t i = 0; i < count; i++) {
        const float scaled = x[i] * gain[i];
        int32_t bits;
        memcpy(&bits, &scaled, sizeof bits);
        bits &= INT32_MAX;
        most = bits > most ? bits : most;
    }
    memcpy(&value, &most, sizeof value);
    return value;
}

/* A dense layer; its inputs in fixed point, of sixteen bits or as many as their sums have room for, which are exact. */
static void dense(const layer *l, const float *x, float *restrict y, psi_state *s) {
    const float limit = largest(x, l->gain, l->inputs);
    const int32_t stride = l->stride;
    if (!(limit > LEAST && limit <= FLT_MAX)) {
        memcpy(y, l->bias, l->outputs * sizeof(float));
        return;
    }
    int16_t *restrict q = s->fixed;
    const int32_t room = INT32_MAX / (128 * stride), most = room < INT16_MAX ? room : INT16_MAX;
    const float step = limit / most, inverse = most / limit;
    for (int32_t i = 0; i < l->inputs; i++)
        q[i] = (int16_t)((int32_t)(x[i] * l->gain[i] * inverse + 32768.5f) - 32768);
    memset(q + l->inputs, 0, (stride - l->inputs) * sizeof *q);
    for (int32_t o = 0; o < l->outputs; o++) {
        const int8_t *restrict w = l->weights + (size_t)o * stride;
        int32_t sum = 0;
        for (int32_t i = 0; i < stride; i++) sum += (int32_t)w[i] * q[i];
        y[o] = l->bias[o] + step * l->scale[o] * (float)sum;
    }
}

static void relu(float *x, int32_t count) {
    for (int32_t i = 0; i < count; i++) x[i] = x[i] > 0.0f ? x[i] : 0.0f;
}

/* Into the range, NaN to its middle; whether it was there but for the slack. */
static int clamp(float *x, const bounds *b, int32_t count) {
    int inside = 1;
    for (int32_t i = 0; i < count; i++) {
        float y = x[i] < b->low[i] ? b->low[i] : x[i] > b->high[i] ? b->high[i] : x[i];
        y = y == y ? y : 0.5f * (b->low[i] + b->high[i]);
        inside &= fabsf(y - x[i]) <= b->slack[i];
        x[i] = y;
    }
    return inside;
}

static void multiply(const float *a, const float *b, float *c) {
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) c[3 * i + k] = a[3 * i] * b[k] + a[3 * i + 1] * b[3 + k] + a[3 * i + 2] * b[6 + k];
}

static void turn(const float *a, const float *x, float *y) {
    for (int i = 0; i < 3; i++) y[i] = a[3 * i] * x[0] + a[3 * i + 1] * x[1] + a[3 * i + 2] * x[2];
}

/* Global rotations and positions of the joints, the root at its canonical place. */
static void kinematics(const psi_model *m, const float *rotations, float *global, float *positions) {
    memcpy(global, rotations, 9 * sizeof(float));
    memcpy(positions, m->rest, 3 * sizeof(float));
    for (int32_t j = 1; j < m->joints; j++) {
        const int32_t p = m->parent[j];
        float bone[3];
        for (int c = 0; c < 3; c++) bone[c] = m->rest[3 * j + c] - m->rest[3 * p + c];
        multiply(global + 9 * p, rotations + 9 * j, global + 9 * j);
        turn(global + 9 * p, bone, positions + 3 * j);
        for (int c = 0; c < 3; c++) positions[3 * j + c] += positions[3 * p + c];
    }
}

/* The inputs of the predictor, without place or heading. */
static void pose_inputs(const psi_model *m, const psi_state *s, float *x) {
    const int32_t joints = m->joints, root = m->input[0];
    const float *now = s->rotations + 9 * (joints + root);
    float cosine = now[0] + now[8], sine = now[2] - now[6], squared = cosine * cosine + sine * sine;
    if (squared < 1e-12f) cosine = 1.0f, sine = 0.0f, squared = 1.0f;
    cosine /= sqrtf(squared), sine /= sqrtf(squared);
    const float back[9] = {cosine, 0, -sine, 0, 1, 0, sine, 0, cosine};
    for (int t = 0; t < 2; t++, x += 3) {
        float velocity[3];
        for (int c = 0; c < 3; c++) velocity[c] = m->fps * (s->translation[3 * t + c] - s->translation[3 * t + 3 + c]);
        turn(back, velocity, x);
    }
    for (int t = 0; t < 3; t++)
        for (int32_t k = 0; k < m->kept; k++, x += 6) {
            const float *r = s->rotations + 9 * (t * joints + m->input[k]);
            float faced[9];
            if (k == 0) multiply(back, r, faced), r = faced;
            for (int c = 0; c < 3; c++) x[c] = r[3 * c], x[3 + c] = r[3 * c + 1];
        }
    for (int t = 0; t < 3; t++)
        for (int32_t k = 1; k < m->kept; k++, x += 3) {
            const float *p = s->positions + 3 * (t * joints + m->input[k]), *q = s->positions + 3 * (t * joints + root);
            const float apart[3] = {p[0] - q[0], p[1] - q[1], p[2] - q[2]};
            turn(back, apart, x);
        }
}

static int sound(const psi_model *m, const float *rotations, const float *translation) {
    int good = 1; /* NaN is not less than anything */
    for (int32_t i = 0; i < 9 * m->joints; i++) good &= fabsf(rotations[i]) < 2.0f;
    for (int c = 0; c < 3; c++) good &= fabsf(translation[c]) < FARTHEST;
    return good;
}

/* The next code from the inputs, in s->next. */
static void predict(const psi_model *m, psi_state *s) {
    const int32_t width = m->pose.outputs;
    float *x = s->rows[0], *y = s->rows[1];
    dense(&m->pose, s->inputs, x, s);
    if (m->previous.inputs) dense(&m->previous, s->latent, y, s);
    for (int32_t i = 0; i < width; i++) x[i] += m->previous.inputs ? y[i] : m->previous.bias[i] + s->latent[i];
    for (int32_t l = 0; l < m->hidden; l++) {
        relu(x, m->then[l].inputs);
        dense(&m->then[l], x, y, s);
        float *swap = x;
        x = y, y = swap;
    }
    for (int32_t i = 0; i < m->code; i++) s->next[i] = (1.0f - m->decay) * s->latent[i] + x[i];
}

/* The garment in the canonical pose [3][vertices]. */
static const float *decode(const psi_model *m, psi_state *s) {
    float *x = s->rows[0], *y = s->rows[1], *read = s->rows[2];
    const int32_t wide = m->decode[0].inputs, last = m->decode[m->decoder - 1].outputs;
    dense(&m->read, s->latent, read, s);
    if (!m->read.inputs)
        for (int32_t i = 0; i < m->read.outputs; i++) read[i] += s->latent[m->code - m->read.outputs + i];
    memcpy(x, read, wide * sizeof(float));
    for (int32_t l = 0; l < m->decoder; l++) {
        relu(x, m->decode[l].inputs);
        dense(&m->decode[l], x, y, s);
        float *swap = x;
        x = y, y = swap;
    }
    for (int32_t i = 0; m->skip && i < last; i++) x[i] += read[wide + i];
    if (m->relu) relu(x, last);
    if (m->mixed) {
        dense(&m->mix, x, y, s);
        x = y, y = s->rows[2];
    }
    dense(&m->shapes, x, y, s);
    return y;
}

static void skin(const psi_model *m, psi_state *s, const float *garment, float *vertices) {
    const int32_t count = m->vertices, padded = (count + LANES - 1) / LANES * LANES;
    for (int32_t k = 0; k < m->moving; k++) {
        const int32_t j = m->bone[k];
        float *to = s->skinning + 12 * k, offset[3];
        turn(s->global + 9 * j, m->rest + 3 * j, offset);
        for (int c = 0; c < 3; c++) {
            memcpy(to + 4 * c, s->global + 9 * j + 3 * c, 3 * sizeof(float));
            to[4 * c + 3] = s->positions[3 * j + c] - offset[c];
        }
    }
    for (int32_t v = 0; v < count; v += LANES) {
        const float *x = garment + v, *y = x + count, *z = y + count;
        float moved[3][LANES] = {{0}}, shown[LANES][3];
        for (int32_t k = 0; k < m->moving; k++) {
            const float *w = m->weight + (size_t)k * padded + v, *a = s->skinning + 12 * k;
            for (int i = 0; i < LANES; i++) {
                moved[0][i] += w[i] * (a[0] * x[i] + a[1] * y[i] + a[2] * z[i] + a[3]);
                moved[1][i] += w[i] * (a[4] * x[i] + a[5] * y[i] + a[6] * z[i] + a[7]);
                moved[2][i] += w[i] * (a[8] * x[i] + a[9] * y[i] + a[10] * z[i] + a[11]);
            }
        }
        for (int i = 0; i < LANES; i++)
            for (int c = 0; c < 3; c++) shown[i][c] = moved[c][i] + s->translation[c];
        memcpy(vertices + 3 * v, shown, 3 * sizeof(float) * (count - v < LANES ? count - v : LANES));
    }
}

static void older(float *rows, size_t size) { memmove(rows + size, rows, 2 * size * sizeof(float)); }

int psi_step(const psi_model *m, psi_state *s, const float *rotations, const float *translation, float *vertices) {
    const size_t joints = m->joints;
    const int finite = sound(m, rotations, translation);
    older(s->rotations, 9 * joints);
    older(s->positions, 3 * joints);
    older(s->translation, 3);
    if (finite) { /* else the newest pose remains */
        memcpy(s->rotations, rotations, 9 * joints * sizeof(float));
        memcpy(s->translation, translation, 3 * sizeof(float));
    }
    kinematics(m, s->rotations, s->global, s->positions);
    pose_inputs(m, s, s->inputs);
    for (int32_t i = 0; i < m->pose.inputs; i++) s->inputs[i] -= m->pose_mean[i];
    const int ordinary = clamp(s->inputs, &m->pose_bounds, m->pose.inputs);
    predict(m, s);
    const int inside = clamp(s->next, &m->code_bounds, m->code);
    float *swap = s->latent;
    s->latent = s->next, s->next = swap;
    if (vertices) skin(m, s, decode(m, s), vertices);
    return finite && ordinary && inside && m->known;
}

/* Gives a state its rows in `room`, or, where that is NULL, only counts the floats that they need. */
static float *part(float *room, size_t *used, size_t count) {
    float *at = room ? room + *used : NULL;
    *used += (count + LANES - 1) / LANES * LANES;
    return at;
}

static size_t arrange(const psi_model *m, psi_state *s, float *room) {
    const size_t joints = m->joints, widest = (size_t)m->widest + LANES; /* what is skinned at once may end there */
    size_t used = 0;
    s->latent = part(room, &used, m->code);
    s->next = part(room, &used, m->code);
    s->rotations = part(room, &used, 27 * joints);
    s->positions = part(room, &used, 9 * joints);
    s->translation = part(room, &used, 9);
    s->global = part(room, &used, 9 * joints);
    s->skinning = part(room, &used, 12 * joints);
    s->inputs = part(room, &used, m->longest);
    for (int i = 0; i < 3; i++) s->rows[i] = part(room, &used, widest);
    s->fixed = (int16_t *)part(room, &used, m->longest / 2);
    return used;
}

psi_state *psi_begin(const psi_model *m, const float *rotations, const float *translation) {
    const size_t joints = m->joints;
    psi_state empty, *s = calloc(1, sizeof *s);
    if (s) s->memory = calloc(arrange(m, &empty, NULL) * sizeof(float) + ALIGN, 1);
    if (!s || !s->memory) {
        free(s);
        return NULL;
    }
    arrange(m, s, (float *)aligned(s->memory));
    memcpy(s->latent, m->start, m->code * sizeof(float));
    if (sound(m, rotations, translation)) {
        memcpy(s->rotations, rotations, 9 * joints * sizeof(float));
        memcpy(s->translation, translation, 3 * sizeof(float));
    } else {
        for (size_t j = 0; j < joints; j++)
            for (int c = 0; c < 3; c++) s->rotations[9 * j + 4 * c] = 1.0f;
    }
    kinematics(m, s->rotations, s->global, s->positions);
    memcpy(s->rotations + 9 * joints, s->rotations, 9 * joints * sizeof(float));
    memcpy(s->positions + 3 * joints, s->positions, 3 * joints * sizeof(float));
    memcpy(s->translation + 3, s->translation, 3 * sizeof(float));
    return s;
}

void psi_end(psi_state *s) {
    if (s) free(s->memory);
    free(s);
}

int psi_carried(const psi_model *m) { return m->code + 24 * m->joints + 6; }

void psi_keep(const psi_model *m, const psi_state *s, float *carried) {
    memcpy(carried, s->latent, m->code * sizeof(float));
    memcpy(carried += m->code, s->rotations, 18 * m->joints * sizeof(float));
    memcpy(carried += 18 * m->joints, s->positions, 6 * m->joints * sizeof(float));
    memcpy(carried + 6 * m->joints, s->translation, 6 * sizeof(float));
}

void psi_put_back(const psi_model *m, psi_state *s, const float *carried) {
    memcpy(s->latent, carried, m->code * sizeof(float));
    memcpy(s->rotations, carried += m->code, 18 * m->joints * sizeof(float));
    memcpy(s->positions, carried += 18 * m->joints, 6 * m->joints * sizeof(float));
    memcpy(s->translation, carried + 6 * m->joints, 6 * sizeof(float));
}
