/* See psi.h. The frame is that of clothjax/runtime/inference.py, the file that of clothjax/export/native.py. */
#include "psi.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PLAIN 1           /* version of a file without forces; ... */
#define FORCED 10         /* ... and with them */
#define ALIGN 64          /* bytes, of all arrays */
#define FARTHEST 1e6f     /* m from the origin */
#define MOST_JOINTS 1024
#define MOST_WIDTH 65536  /* inputs of a layer: their sums have room in 32 bits */
#define MOST_HIDDEN 16
#define MOST_STEPS 64
#define MOST_ELEMENTS (1 << 20)
#define LANES 64          /* vertices that are skinned at once */
#define LEAST 1e-30f      /* inputs of a layer that are smaller than this are nothing */
#define KINDS 3           /* of forces: momentum, elasticity, contact */
#define NEIGHBOURS 8      /* vertices, or edges, of a cluster */
#define PATCH 16          /* faces of the body in one */
#define PLACES 512        /* a power of two; PATCH fewer faces are compared before it is noted which are nearest */
#define BOUND 5.0f        /* of the scaled inputs of a predictor with forces */
#define SLIVER 1e-6f      /* twice the area, over a hinge's squared size, below which a face has no direction */
#define SETTLING 60       /* frames that a garment with forces settles for before the first */
#define STILL 2.5e-5f     /* of rotation matrices, and in m: a pose that changes by less stands still */
#define AWAKE 60          /* frames that the cloth moves freely for on a body that stands still; then ... */
#define SLOWING 0.95f     /* ... in each frame the change of the code shrinks by this */
#define LONGEST 0.005f    /* m, by which the gradient moves a vertex in a step of relaxation at most */
#define RAISED 1.5f       /* heights of arcs, of planes that a garment touches which does not feel */
#define FLAT 1e-3f        /* least determinant of a transform that is inverted */

typedef struct { /* y = bias + scale * (weights (gain * x)); without inputs the bias alone */
    int32_t inputs, outputs, stride;
    const float *gain, *bias, *scale;
    const int8_t *weights; /* [outputs][stride] */
} layer;

typedef struct {
    const float *low, *high, *slack;
} bounds;

typedef struct { /* a square matrix in sixteen bits: the rest of the first is in the second */
    layer coarse, fine;
} exact;

typedef struct { /* a garment whose stretching is known; rows end at multiples of LANES */
    int32_t vertices, triangles;
    const int32_t *corner;           /* [3][triangles] */
    const float *inverse, *mu, *lam; /* [4][triangles]; 2 mu and lam times area and thickness */
    const float *mobility;           /* [vertices] m/N, in a step of relaxation */
    int32_t steps;                   /* of relaxation, and ... */
    float momentum;                  /* ... theirs */
} fabric;

typedef struct { /* what a predictor with forces knows of the cloth and of the body; rows end at multiples of LANES */
    int32_t vertices, hinges, body, faces, clusters, edges, edge_clusters;
    fabric felt, shown;                               /* the latter, if it is relaxed by itself, has triangles */
    float timestep, gravity;
    float stiffness, offset;                          /* N/m and m, of planes that are touched; ... */
    float highest, deepest, reach;                    /* ... m, raised, pushed, and far from an edge at most */
    const float *mass;                                /* [vertices] */
    const int32_t *hinge;                             /* [4][hinges] */
    const float *bend, *angle;                        /* [hinges] */
    const int32_t *face, *edge;                       /* [3][faces], by PATCH; [2][edges] */
    const int32_t *cluster, *edge_cluster;            /* [clusters][NEIGHBOURS] vertices, [edge_clusters] ... edges */
    const float *body_weight, *body_rest;             /* [moving][body], [3][body] */
    const float *weight;                              /* [moving][vertices] */
    const int32_t *around;                            /* [3][vertices that are shown], those that feel, nearest first */
    const float *share;                               /* [3] ... how much of their relaxation it takes */
    const int32_t *beside;  /* [besides][...] what touches the planes it may touch: those that feel, then their edges */
    int32_t besides;
    int32_t rounds, turns;  /* in which what is shown is pushed out of those planes and relaxed, by turns, and ... */
    float turning;          /* ... the momentum of that */
    const float *middle, *inverse_spread;             /* of the inputs [(2 + KINDS) code], over BOUND */
    layer unshape, unmix, undecode[MOST_HIDDEN], first; /* transposed shapes, mix, layers of the decoder */
    layer read_fine;                                  /* the rest of the decoder's first, in sixteen bits */
    layer felt_shapes;                                /* of the garment that feels, if it is not the one shown */
    exact unread, change, move;
} forces;

struct psi_model {
    void *file;
    int32_t forced, apart; /* with forces; with a garment that feels apart from the one that is shown, ... */
    int32_t alone;         /* ... which is relaxed by itself */
    forces f;
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
    int outside; /* of the last frame, psi_outside() */
    float *latent, *next;
    float *rotations, *positions, *translation;  /* [3][joints][9], [3][joints][3], [3][3], newest first */
    float *global, *skinning;                    /* rotations [joints][9]; matrices [moving][12] */
    float *inputs, *rows[3];
    int16_t *fixed; /* inputs of layers in fixed point */
    /* with forces, rows [vertices, to a multiple of LANES] */
    float external[3];
    int pushed;  /* whether the external acceleration was finite */
    float still; /* frames for which the body has stood still and nothing has pushed */
    float *change, *garment, *position, *velocity; /* of the code; the garment, canonical, in the world, its motion */
    float *held, *blended, *force, *body, *centre; /* [3], [12], [KINDS][3]; of the body [3][body], [3][faces] */
    float *patch;          /* [4][faces / PATCH], middle and radius of clusters of faces */
    int8_t *near;          /* [faces / PATCH] whether one may hold what is nearest */
    int32_t *nearest;      /* the face that is nearest */
    float *plane, *raised; /* [4], normal and place of what is touched, from the last root; how far it feels raised */
    float *target;         /* how far outside of it a vertex is pushed to be shown */
    /* [3], [3], [4] and [1] rows [vertices that are shown], if they are relaxed by themselves */
    float *shown, *moved, *plane_shown, *aim;
    float *eased;          /* [3], what is relaxed, a step before */
    /* rows [edges, to a multiple of LANES] */
    float *between;        /* [3], the middles of edges */
    int32_t *nearest_between;
    float *plane_between, *target_between;
    float *pulled[KINDS], *read[MOST_HIDDEN + 1];  /* gradients of weights and codes; what layers of the decoder give */
};

/* reading */

static int32_t padded(int32_t count) { return (count + LANES - 1) / LANES * LANES; }

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

static int takes(const layer *l, int32_t inputs, int32_t outputs) {
    return l->inputs == inputs && l->outputs == outputs;
}

static int takes_exact(const exact *e, int32_t inputs, int32_t outputs) {
    return takes(&e->coarse, inputs, outputs) && takes(&e->fine, inputs, outputs);
}

/* Whether every layer of a predictor with forces takes what there is for it. */
static int fits_forces(const psi_model *m) {
    const forces *f = &m->f;
    const int32_t code = m->code, last = m->decode[m->decoder - 1].outputs;
    int good = takes(&f->read_fine, code, m->read.outputs) && m->read.outputs > 0 && m->shapes.inputs > 0 && last > 0;
    good &= takes(&f->unshape, 3 * f->vertices, m->shapes.inputs);
    good &= !m->mixed || takes(&f->unmix, m->mix.outputs, last);
    good &= m->apart ? takes(&f->felt_shapes, m->shapes.inputs, 3 * f->vertices) : f->vertices == m->vertices;
    for (int32_t i = 0; i < m->decoder; i++)
        good &= m->decode[i].outputs > 0 && takes(&f->undecode[i], m->decode[i].outputs, m->decode[i].inputs);
    good &= takes_exact(&f->unread, m->read.outputs, code) && takes_exact(&f->change, code, code) &&
            takes_exact(&f->move, code, code);
    int32_t width = f->first.outputs - code;
    good &= f->first.inputs == (2 + KINDS) * code && width > 0;
    for (int32_t i = 0; i < m->hidden; i++) {
        good &= m->then[i].inputs == width;
        width = m->then[i].outputs;
    }
    return good && (width == code || width == (2 + KINDS) * code);
}

/* Whether every layer takes what there is for it. */
static int fits(const psi_model *m) {
    int32_t width = m->pose.outputs, wide = m->decoder ? m->decode[0].inputs : 0, shapes;
    int good = m->hidden > 0 && m->decoder > 0;
    if (m->forced) {
        good = good && fits_forces(m);
    } else {
        good &= m->pose.inputs == 6 + 18 * m->kept + 9 * (m->kept - 1);
        good &= m->previous.outputs == width && (m->previous.inputs ? m->previous.inputs == m->code : width <= m->code);
        for (int32_t i = 0; i < m->hidden; i++) {
            good &= m->then[i].inputs == width;
            width = m->then[i].outputs;
        }
        good &= width == m->code;
    }
    good &= (m->read.inputs ? m->read.inputs == m->code : m->read.outputs <= m->code);
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

static exact read_exact(reader *r, psi_model *m) {
    exact e;
    e.coarse = read_layer(r, m);
    e.fine = read_layer(r, m);
    return e;
}

static float fraction(reader *r, float momentum) {
    if (!(momentum >= 0.0f && momentum < 1.0f)) r->sound = 0;
    return momentum;
}

static fabric read_fabric(reader *r, int32_t vertices, int32_t triangles, int32_t steps, float momentum) {
    fabric c = {vertices, triangles, NULL, NULL, NULL, NULL, NULL, steps, fraction(r, momentum)};
    c.corner = indices(r, 3 * padded(triangles), vertices);
    c.inverse = floats(r, 4 * (size_t)padded(triangles));
    c.mu = floats(r, padded(triangles));
    c.lam = floats(r, padded(triangles));
    if (steps) c.mobility = floats(r, padded(vertices));
    return c;
}

static void read_forces(reader *r, psi_model *m) {
    forces *f = &m->f;
    const int32_t *head = integers(r, 14);
    const float *rates = floats(r, 10);
    if (!r->sound) return;
    f->vertices = within(r, head[0], 1, MOST_ELEMENTS);
    const int32_t triangles = within(r, head[1], 0, MOST_ELEMENTS), shown = within(r, head[10], 0, MOST_ELEMENTS);
    f->hinges = within(r, head[2], 0, MOST_ELEMENTS);
    f->body = within(r, head[3], 1, MOST_ELEMENTS);
    f->faces = within(r, head[4], 1, MOST_ELEMENTS);
    f->clusters = within(r, head[5], 1, MOST_ELEMENTS / NEIGHBOURS);
    if (f->faces % PATCH) r->sound = 0;
    m->apart = head[6];
    f->edges = within(r, head[7], 0, MOST_ELEMENTS);
    f->edge_clusters = within(r, head[8], 0, MOST_ELEMENTS / NEIGHBOURS);
    f->timestep = rates[0], f->gravity = rates[1], f->stiffness = rates[2], f->offset = rates[3];
    f->highest = rates[4], f->deepest = rates[5], f->reach = rates[6];
    f->mass = floats(r, padded(f->vertices));
    f->felt = read_fabric(r, f->vertices, triangles, within(r, head[9], 0, MOST_STEPS), rates[7]);
    f->hinge = indices(r, 4 * padded(f->hinges), f->vertices);
    f->bend = floats(r, padded(f->hinges));
    f->angle = floats(r, padded(f->hinges));
    f->face = indices(r, 3 * padded(f->faces), f->body);
    f->cluster = indices(r, NEIGHBOURS * f->clusters, f->vertices);
    f->edge = indices(r, 2 * padded(f->edges), f->vertices);
    f->edge_cluster = indices(r, NEIGHBOURS * f->edge_clusters, f->edges);
    f->body_weight = floats(r, (size_t)m->moving * padded(f->body));
    f->body_rest = floats(r, 3 * (size_t)padded(f->body));
    f->weight = m->apart ? floats(r, (size_t)m->moving * padded(f->vertices)) : m->weight;
    if (m->apart) f->around = indices(r, 3 * padded(m->vertices), f->vertices);
    if (m->apart) f->share = floats(r, 3 * (size_t)padded(m->vertices));
    m->alone = m->apart && shown > 0;
    if (m->alone) f->shown = read_fabric(r, m->vertices, shown, within(r, head[11], 1, MOST_STEPS), rates[8]);
    f->rounds = within(r, head[12], 1, MOST_STEPS), f->turns = within(r, head[13], 0, MOST_STEPS);
    f->turning = fraction(r, rates[9]);
    f->besides = f->edge_clusters ? 6 : 3;
    if (m->alone) f->beside = indices(r, f->besides * padded(m->vertices), f->vertices + f->edges);
    f->middle = floats(r, (2 + KINDS) * (size_t)m->code);
    f->inverse_spread = floats(r, (2 + KINDS) * (size_t)m->code);
    f->read_fine = read_layer(r, m);
    f->unshape = read_layer(r, m);
    if (m->mixed) f->unmix = read_layer(r, m);
    for (int32_t i = 0; i < m->decoder; i++) f->undecode[i] = read_layer(r, m);
    f->unread = read_exact(r, m);
    f->change = read_exact(r, m);
    f->first = read_layer(r, m);
    f->move = read_exact(r, m);
    if (m->apart) f->felt_shapes = read_layer(r, m);
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
    m->weight = floats(r, (size_t)m->moving * padded(m->vertices));
    m->forced = head[13];
    int32_t poses = m->forced ? 0 : 6 + 18 * m->kept + 9 * (m->kept - 1);
    m->pose_mean = floats(r, poses);
    m->pose_bounds = read_bounds(r, poses);
    m->code_bounds = read_bounds(r, m->code);
    m->start = floats(r, m->code);
    if (!m->forced) m->pose = read_layer(r, m);
    if (!m->forced) m->previous = read_layer(r, m);
    for (int32_t i = 0; i < m->hidden; i++) m->then[i] = read_layer(r, m);
    m->read = read_layer(r, m);
    for (int32_t i = 0; i < m->decoder; i++) m->decode[i] = read_layer(r, m);
    if (m->mixed) m->mix = read_layer(r, m);
    m->shapes = read_layer(r, m);
    if (r->sound && m->forced) read_forces(r, m);
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
    const int32_t name = 0x00495350; /* "PSI"; then the version */
    int32_t version[2] = {0, 0};
    if (size >= ALIGN) memcpy(version, bytes, sizeof version);
    if (version[0] != name || (version[1] != PLAIN && version[1] != FORCED))
        return failed(m, error, "not a .psi of this version");
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

static void quantise(const layer *l, const float *x, float inverse, int16_t *restrict q) {
    for (int32_t i = 0; i < l->inputs; i++)
        q[i] = (int16_t)((int32_t)(x[i] * l->gain[i] * inverse + 32768.5f) - 32768);
    memset(q + l->inputs, 0, (l->stride - l->inputs) * sizeof *q);
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
    quantise(l, x, inverse, q);
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

/* Adds a dense layer without bias to y. */
static void add_dense(const layer *l, const float *x, float *y, float *spare, psi_state *s) {
    dense(l, x, spare, s);
    for (int32_t i = 0; i < l->outputs; i++) y[i] += spare[i];
}

static void first_of_decoder(const psi_model *m, psi_state *s, float *read, float *spare) {
    dense(&m->read, s->latent, read, s);
    if (m->forced) add_dense(&m->f.read_fine, s->latent, read, spare, s);
}

/* The garment in the canonical pose [3][vertices]. */
static float *decode(const psi_model *m, psi_state *s, const layer *shapes) {
    float *x = s->rows[0], *y = s->rows[1], *read = s->rows[2];
    const int32_t wide = m->decode[0].inputs, last = m->decode[m->decoder - 1].outputs;
    first_of_decoder(m, s, read, x);
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
    dense(shapes, x, y, s);
    return y;
}

/* The transforms of the joints that move something, in s->skinning. */
static void bones(const psi_model *m, psi_state *s) {
    for (int32_t k = 0; k < m->moving; k++) {
        const int32_t j = m->bone[k];
        float *to = s->skinning + 12 * k, offset[3];
        turn(s->global + 9 * j, m->rest + 3 * j, offset);
        for (int c = 0; c < 3; c++) {
            memcpy(to + 4 * c, s->global + 9 * j + 3 * c, 3 * sizeof(float));
            to[4 * c + 3] = s->positions[3 * j + c] - offset[c];
        }
    }
}

/* Whether any of LANES vertices has weight on a joint; most joints have none of neighbours. */
static int carries(const float *weight) {
    int any = 0;
    for (int i = 0; i < LANES; i++) any |= weight[i] != 0.0f;
    return any;
}

/* LANES vertices at x, y, z with weights [moving][wide], skinned; added to `moved`, zeros before. */
static void skin_lanes(const psi_model *m, const psi_state *s, const float *weight, size_t wide, const float *x,
                       const float *y, const float *z, float moved[3][LANES]) {
    for (int32_t k = 0; k < m->moving; k++) {
        const float *w = weight + k * wide, *a = s->skinning + 12 * k;
        if (!carries(w)) continue;
        for (int i = 0; i < LANES; i++) {
            moved[0][i] += w[i] * (a[0] * x[i] + a[1] * y[i] + a[2] * z[i] + a[3]);
            moved[1][i] += w[i] * (a[4] * x[i] + a[5] * y[i] + a[6] * z[i] + a[7]);
            moved[2][i] += w[i] * (a[8] * x[i] + a[9] * y[i] + a[10] * z[i] + a[11]);
        }
    }
}

static void skin(const psi_model *m, psi_state *s, const float *garment, float *vertices) {
    const int32_t count = m->vertices, wide = padded(count);
    for (int32_t v = 0; v < count; v += LANES) {
        const float *x = garment + v, *y = x + count, *z = y + count;
        float moved[3][LANES] = {{0}}, shown[LANES][3];
        skin_lanes(m, s, m->weight + v, wide, x, y, z, moved);
        for (int i = 0; i < LANES; i++)
            for (int c = 0; c < 3; c++) shown[i][c] = moved[c][i] + s->translation[c];
        memcpy(vertices + 3 * v, shown, 3 * sizeof(float) * (count - v < LANES ? count - v : LANES));
    }
}

/* forces: clothjax/runtime/drape.py; elastic ones in closed form */

/* An exact layer, into y. */
static void dense_exact(const exact *e, const float *x, float *y, float *spare, psi_state *s) {
    dense(&e->coarse, x, y, s);
    add_dense(&e->fine, x, y, spare, s);
}

/* A dense layer without bias on all kinds at once: reading its weights takes longest. */
static void dense_kinds(const layer *l, float *const *x, float *const *y, psi_state *s) {
    const int32_t stride = l->stride, room = INT32_MAX / (128 * stride), most = room < INT16_MAX ? room : INT16_MAX;
    const int16_t *q[KINDS];
    float step[KINDS];
    for (int k = 0; k < KINDS; k++) {
        const float limit = largest(x[k], l->gain, l->inputs);
        const int some = limit > LEAST && limit <= FLT_MAX;
        step[k] = some ? limit / most : limit <= LEAST ? 0.0f : NAN;
        q[k] = s->fixed + (size_t)k * stride;
        if (some) {
            quantise(l, x[k], most / limit, s->fixed + (size_t)k * stride);
        } else {
            memset(s->fixed + (size_t)k * stride, 0, stride * sizeof(int16_t));
        }
    }
    const int16_t *restrict a = q[0], *restrict b = q[1], *restrict c = q[2];
    for (int32_t o = 0; o < l->outputs; o++) {
        const int8_t *restrict w = l->weights + (size_t)o * stride;
        int32_t first = 0, second = 0, third = 0;
        for (int32_t i = 0; i < stride; i++) {
            first += (int32_t)w[i] * a[i];
            second += (int32_t)w[i] * b[i];
            third += (int32_t)w[i] * c[i];
        }
        y[0][o] = step[0] * l->scale[o] * (float)first;
        y[1][o] = step[1] * l->scale[o] * (float)second;
        y[2][o] = step[2] * l->scale[o] * (float)third;
    }
}

/* The transforms [12][vertices] of vertices, from those of the joints. */
static void blend(const psi_model *m, const psi_state *s, const float *weight, int32_t count, float *rows) {
    const int32_t wide = padded(count);
    for (int32_t v = 0; v < wide; v += LANES) {
        int32_t busy[MOST_JOINTS], joints = 0;
        for (int32_t k = 0; k < m->moving; k++)
            if (carries(weight + (size_t)k * wide + v)) busy[joints++] = k;
        for (int c = 0; c < 12; c++) {
            float sum[LANES] = {0};
            for (int32_t k = 0; k < joints; k++) {
                const float *w = weight + (size_t)busy[k] * wide + v, a = s->skinning[12 * busy[k] + c];
                for (int i = 0; i < LANES; i++) sum[i] += w[i] * a;
            }
            memcpy(rows + (size_t)c * wide + v, sum, sizeof sum);
        }
    }
}

/* Rows [3][wide] moved by transforms [12][wide], and by an offset [3]. */
static void apply(const float *restrict rows, const float *restrict x, const float *offset, size_t wide,
                  float *restrict moved) {
    for (int c = 0; c < 3; c++) {
        const float *r = rows + 4 * c * wide, by = offset[c];
        for (size_t v = 0; v < wide; v++)
            moved[c * wide + v] = r[v] * x[v] + r[wide + v] * x[wide + v] + r[2 * wide + v] * x[2 * wide + v] +
                                  r[3 * wide + v] + by;
    }
}

/* The part of the body that can be touched, relative to the root of the last frame, and the centres of its faces. */
static void pose_body(const psi_model *m, psi_state *s, const float *advance) {
    const forces *f = &m->f;
    const int32_t wide = padded(f->body), faces = padded(f->faces);
    for (int32_t v = 0; v < wide; v += LANES) {
        const float *x = f->body_rest + v, *y = x + wide, *z = y + wide;
        float moved[3][LANES] = {{0}};
        skin_lanes(m, s, f->body_weight + v, wide, x, y, z, moved);
        for (int c = 0; c < 3; c++)
            for (int i = 0; i < LANES; i++) s->body[c * wide + v + i] = moved[c][i] + advance[c];
    }
    for (int c = 0; c < 3; c++) {
        const float *x = s->body + c * wide;
        const int32_t *a = f->face, *b = a + faces, *d = b + faces;
        for (int32_t i = 0; i < faces; i++) s->centre[c * faces + i] = (x[a[i]] + x[b[i]] + x[d[i]]) / 3.0f;
    }
}

/* 1 / sqrt(x) of a positive x, by three steps of Newton: sqrtf may set errno, and keeps loops from being vectors. */
static inline float inverse_root(float x) {
    int32_t bits;
    float y;
    memcpy(&bits, &x, sizeof bits);
    bits = 0x5f3759df - (bits >> 1);
    memcpy(&y, &bits, sizeof y);
    for (int i = 0; i < 3; i++) y *= 1.5f - 0.5f * x * y * y;
    return y;
}

static inline void cross(const float *a, const float *b, float *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static void push_momentum(const psi_model *m, psi_state *s, float *restrict force) {
    const forces *f = &m->f;
    const size_t wide = padded(f->vertices);
    const float rate = 1.0f / (f->timestep * f->timestep);
    for (int c = 0; c < 3; c++) {
        const float *held = s->held + c * wide, *x = s->position + c * wide, *v = s->velocity + c * wide;
        const float beside = s->external[c] - (c == 1 ? f->gravity : 0.0f);
        for (size_t i = 0; i < wide; i++)
            force[c * wide + i] = f->mass[i] * (beside - rate * (held[i] - x[i] - v[i]));
    }
}

/* Middles and radii of the clusters of faces. */
static void find_patches(const psi_model *m, psi_state *s) {
    const int32_t faces = padded(m->f.faces), patches = m->f.faces / PATCH, row = padded(patches);
    float *middle = s->patch, *radius = middle + 3 * row;
    for (int32_t p = 0; p < patches; p++) {
        const float *centre = s->centre + p * PATCH;
        float apart[PATCH] = {0}, farthest = 0.0f;
        for (int c = 0; c < 3; c++) {
            float sum = 0.0f;
            for (int i = 0; i < PATCH; i++) sum += centre[c * faces + i];
            middle[c * row + p] = sum / PATCH;
            for (int i = 0; i < PATCH; i++) {
                const float x = centre[c * faces + i] - sum / PATCH;
                apart[i] += x * x;
            }
        }
        for (int i = 0; i < PATCH; i++) farthest = apart[i] > farthest ? apart[i] : farthest;
        radius[p] = sqrtf(farthest);
    }
}

/* Compares positions [3][NEIGHBOURS] with the faces of a cluster. The last bits of the least squared distances hold
   which face it is, of those compared so far: `first` and the next ones. */
static void compare(const float *restrict x, const float *restrict centre, size_t faces, int32_t first,
                    int32_t *restrict least) {
    for (int j = 0; j < PATCH; j++) {
        const float cx = centre[j], cy = centre[faces + j], cz = centre[2 * faces + j];
#pragma GCC unroll 1 /* else it is unrolled before it can become vectors */
        for (int i = 0; i < NEIGHBOURS; i++) {
            const float a = x[i] - cx, b = x[NEIGHBOURS + i] - cy, c = x[2 * NEIGHBOURS + i] - cz;
            const float apart = a * a + b * b + c * c;
            int32_t whole;
            memcpy(&whole, &apart, sizeof whole);
            whole = (whole & ~(PLACES - 1)) | (first + j);
            least[i] = whole < least[i] ? whole : least[i];
        }
    }
}

/* Middles of the edges of the garment in s->held. */
static void find_middles(const forces *f, psi_state *s) {
    const size_t wide = padded(f->vertices), edges = padded(f->edges);
    for (int c = 0; c < 3; c++) {
        const float *x = s->held + c * wide;
        for (size_t e = 0; e < edges; e++) s->between[c * edges + e] = 0.5f * (x[f->edge[e]] + x[f->edge[edges + e]]);
    }
}

/* Takes over which faces are nearest, of the clusters that were compared; returns the number of the next one. */
static int32_t settle_faces(int32_t *least, const int32_t *chosen, int32_t *face) {
    for (int i = 0; i < NEIGHBOURS; i++) {
        const int32_t place = least[i] & (PLACES - 1);
        if (place >= PATCH) face[i] = chosen[place / PATCH] * PATCH + place % PATCH;
        least[i] -= place;
    }
    return 1;
}

/* Finds the faces whose centres are nearest to the positions of a cluster, rows [3][wide] at `asked`, if they are not
   farther than `reach`; else they stay as they are. In jax it is clusters.nearest_in_clusters, which may miss some. */
static void find_faces(const psi_model *m, const psi_state *s, const float *rows, size_t wide, const int32_t *asked,
                       float reach, int32_t *face) {
    const int32_t faces = padded(m->f.faces), patches = m->f.faces / PATCH, row = padded(patches);
    const float *middle = s->patch, *radius = middle + 3 * row;
    float x[3][NEIGHBOURS], mean[3] = {0}, span = 0.0f;
    int32_t least[NEIGHBOURS], chosen[PLACES / PATCH], count = 1, bits = 1, nearest = INT32_MAX;
    for (int c = 0; c < 3; c++)
        for (int i = 0; i < NEIGHBOURS; i++) mean[c] += (x[c][i] = rows[c * wide + asked[i]]) / NEIGHBOURS;
    const float most = reach * reach;
    memcpy(least, &most, sizeof least[0]);
    least[0] &= ~(PLACES - 1); /* a place in the first PATCH: found before */
    for (int i = 0; i < NEIGHBOURS; i++) {
        const float a = x[0][i] - mean[0], b = x[1][i] - mean[1], c = x[2][i] - mean[2];
        least[i] = least[0];
        span = a * a + b * b + c * c > span ? a * a + b * b + c * c : span;
    }
    /* the cluster of faces whose middle is nearest tells how far the nearest faces are at most */
    while (bits < patches) bits *= 2;
    for (int32_t p = 0; p < patches; p++) {
        const float a = middle[p] - mean[0], b = middle[row + p] - mean[1], c = middle[2 * row + p] - mean[2];
        const float square = a * a + b * b + c * c;
        int32_t whole;
        memcpy(&whole, &square, sizeof whole);
        whole = (whole & ~(bits - 1)) | p;
        nearest = whole < nearest ? whole : nearest;
    }
    const int32_t best = nearest & (bits - 1);
    chosen[count] = best;
    compare(x[0], s->centre + best * PATCH, faces, PATCH * count++, least);
    int32_t largest = 0;
    for (int i = 0; i < NEIGHBOURS; i++) largest = least[i] > largest ? least[i] : largest;
    float farthest;
    largest |= PLACES - 1;
    memcpy(&farthest, &largest, sizeof farthest);
    const float within = (sqrtf(span) + sqrtf(farthest)) * 1.001f + 1e-6f; /* for rounding */
    int8_t *near = s->near;
    for (int32_t p = 0; p < patches; p++) {
        const float a = middle[p] - mean[0], b = middle[row + p] - mean[1], c = middle[2 * row + p] - mean[2];
        const float bound = radius[p] + within;
        near[p] = a * a + b * b + c * c <= bound * bound;
    }
    near[best] = 0;
    for (int32_t first = 0; first < patches; first += 8) {
        int64_t any;
        memcpy(&any, near + first, sizeof any);
        for (int32_t p = first; any && p < first + 8; p++) {
            if (!near[p]) continue;
            if (count == PLACES / PATCH) count = settle_faces(least, chosen, face);
            chosen[count] = p;
            compare(x[0], s->centre + p * PATCH, faces, PATCH * count++, least);
        }
    }
    settle_faces(least, chosen, face);
}

/* The same for all vertices of the held garment and, if it is shown, for the middles of its edges. */
static void find_nearest(const psi_model *m, psi_state *s, int32_t edge_clusters) {
    const forces *f = &m->f;
    const size_t wide = padded(f->vertices), edges = padded(f->edges);
    find_patches(m, s);
    for (int32_t g = 0; g < f->clusters; g++) {
        const int32_t *asked = f->cluster + g * NEIGHBOURS;
        int32_t face[NEIGHBOURS] = {0};
        find_faces(m, s, s->held, wide, asked, FARTHEST, face);
        for (int i = 0; i < NEIGHBOURS; i++) s->nearest[asked[i]] = face[i];
    }
    for (size_t e = 0; edge_clusters && e < edges; e++) s->nearest_between[e] = -1;
    for (int32_t g = 0; g < edge_clusters; g++) {
        const int32_t *asked = f->edge_cluster + g * NEIGHBOURS;
        int32_t face[NEIGHBOURS];
        for (int i = 0; i < NEIGHBOURS; i++) face[i] = -1;
        find_faces(m, s, s->between, edges, asked, f->reach, face);
        for (int i = 0; i < NEIGHBOURS; i++) s->nearest_between[asked[i]] = face[i];
    }
    for (size_t e = 0; edge_clusters && e < edges; e++) {
        s->target_between[e] = s->nearest_between[e] < 0 ? -FARTHEST : f->offset;
        s->nearest_between[e] = s->nearest_between[e] < 0 ? 0 : s->nearest_between[e];
    }
}

/* The planes [4][wide] of the faces that are nearest. */
static void find_planes(const psi_model *m, const psi_state *s, const int32_t *nearest, size_t wide, float *planes) {
    const forces *f = &m->f;
    const int32_t faces = padded(f->faces), body = padded(f->body);
    const float *cx = s->centre, *cy = cx + faces, *cz = cy + faces;
    for (size_t v = 0; v < wide; v += LANES) {
        for (int i = 0; i < LANES; i++) {
            const int32_t j = nearest[v + i];
            float e[3], l[3], normal[3];
            for (int c = 0; c < 3; c++) {
                const float *p = s->body + c * body;
                e[c] = p[f->face[faces + j]] - p[f->face[j]];
                l[c] = p[f->face[2 * faces + j]] - p[f->face[j]];
            }
            cross(e, l, normal);
            const float square = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
            const float size = square > 1e-30f ? inverse_root(square) : 0.0f;
            float *plane = planes + v + i;
            for (int c = 0; c < 3; c++) plane[c * wide] = size * normal[c];
            plane[3 * wide] = plane[0] * cx[j] + plane[wide] * cy[j] + plane[2 * wide] * cz[j];
        }
    }
}

/* How far the planes of an edge's ends are raised: as far as the body, if it is round, bulges out between them. */
static void raise_planes(const psi_model *m, psi_state *s) {
    const forces *f = &m->f;
    const int32_t wide = padded(f->vertices), edges = padded(f->edges);
    float *raised = s->raised;
    memset(raised, 0, wide * sizeof(float));
    for (int32_t e = 0; e < edges; e += LANES) {
        const int32_t *start = f->edge + e, *end = start + edges;
        float bulge[LANES] = {0};
        for (int c = 0; c < 3; c++) {
            const float *n = s->plane + c * wide, *x = s->held + c * wide;
            for (int i = 0; i < LANES; i++) bulge[i] += (n[start[i]] - n[end[i]]) * (x[start[i]] - x[end[i]]);
        }
        for (int i = 0; i < LANES; i++) {
            const float b = bulge[i] / 8 < f->highest ? bulge[i] / 8 : f->highest;
            if (raised[start[i]] < b) raised[start[i]] = b;
            if (raised[end[i]] < b) raised[end[i]] = b;
        }
    }
}

/* Pushes the garment out of its raised planes, as springs would. */
static void push_contact(const psi_model *m, psi_state *s, float *restrict force) {
    const size_t wide = padded(m->f.vertices);
    const float *plane = s->plane, *x = s->held, stiffness = m->f.stiffness, offset = m->f.offset;
    for (size_t v = 0; v < wide; v++) {
        float gap = -plane[3 * wide + v] - s->raised[v];
        for (size_t c = 0; c < 3; c++) gap += plane[c * wide + v] * x[c * wide + v];
        const float push = gap < offset ? stiffness * (offset - gap) : 0.0f;
        for (size_t c = 0; c < 3; c++) force[c * wide + v] = push * plane[c * wide + v];
    }
}

/* Corners of elements [count][3][LANES], from rows [3][wide]; and gradients there, taken from the force. */
static void gather(const float *rows, size_t wide, const int32_t *index, size_t stride, int count,
                   float to[][3][LANES]) {
    for (int k = 0; k < count; k++)
        for (int c = 0; c < 3; c++)
            for (int i = 0; i < LANES; i++) to[k][c][i] = rows[c * wide + index[k * stride + i]];
}

static void scatter(float *rows, size_t wide, const int32_t *index, size_t stride, int count,
                    float from[][3][LANES]) {
    for (int k = 0; k < count; k++)
        for (int i = 0; i < LANES; i++)
            for (int c = 0; c < 3; c++) rows[c * wide + index[k * stride + i]] -= from[k][c][i];
}

static void push_stretching(const fabric *f, const float *held, float *force) {
    const size_t wide = padded(f->vertices), count = padded(f->triangles);
    for (size_t t = 0; t < count; t += LANES) {
        float x[3][3][LANES], g[3][3][LANES];
        gather(held, wide, f->corner + t, count, 3, x);
        for (int i = 0; i < LANES; i++) {
            const float a = f->inverse[t + i], b = f->inverse[count + t + i], c = f->inverse[2 * count + t + i],
                        d = f->inverse[3 * count + t + i];
            float along[3], across[3], left[3], right[3];
            for (int k = 0; k < 3; k++) {
                const float p = x[0][k][i] - x[2][k][i], q = x[1][k][i] - x[2][k][i];
                along[k] = a * p + c * q;
                across[k] = b * p + d * q;
            }
            const float s0 = 0.5f * (along[0] * along[0] + along[1] * along[1] + along[2] * along[2] - 1.0f),
                        s1 = 0.5f * (along[0] * across[0] + along[1] * across[1] + along[2] * across[2]),
                        s2 = 0.5f * (across[0] * across[0] + across[1] * across[1] + across[2] * across[2] - 1.0f),
                        trace = f->lam[t + i] * (s0 + s2), k0 = f->mu[t + i] * s0 + trace,
                        k1 = f->mu[t + i] * s1, k2 = f->mu[t + i] * s2 + trace;
            for (int k = 0; k < 3; k++) {
                left[k] = k0 * along[k] + k1 * across[k];
                right[k] = k1 * along[k] + k2 * across[k];
                g[0][k][i] = a * left[k] + b * right[k];
                g[1][k][i] = c * left[k] + d * right[k];
                g[2][k][i] = -g[0][k][i] - g[1][k][i];
            }
        }
        scatter(force, wide, f->corner + t, count, 3, g);
    }
}

/* The arc tangent of y / x (Abramowitz and Stegun 4.4.49), without a branch. */
static inline float arc(float y, float x) {
    const float a = fabsf(x), b = fabsf(y), more = a > b ? a : b, less = a > b ? b : a;
    const float q = more > 0.0f ? less / more : 0.0f, t = q * q;
    float angle = q * (1.0f + t * (-0.3333314528f + t * (0.1999355085f + t * (-0.1420889944f + t * (0.1065626393f +
                  t * (-0.0752896400f + t * (0.0429096138f + t * (-0.0161657367f + t * 0.0028662257f))))))));
    angle = b > a ? 1.57079633f - angle : angle;
    angle = x < 0.0f ? 3.14159265f - angle : angle;
    return y < 0.0f ? -angle : angle;
}

static void push_bending(const forces *f, const float *held, float *force) {
    const size_t wide = padded(f->vertices), count = padded(f->hinges);
    for (size_t h = 0; h < count; h += LANES) {
        float x[4][3][LANES], g[4][3][LANES];
        gather(held, wide, f->hinge + h, count, 4, x);
        for (int i = 0; i < LANES; i++) {
            /* one name a coordinate, else the loop does not become vectors */
            const float ax = x[0][0][i], ay = x[0][1][i], az = x[0][2][i];
            const float ex = x[1][0][i] - ax, ey = x[1][1][i] - ay, ez = x[1][2][i] - az;
            const float lx = x[2][0][i] - ax, ly = x[2][1][i] - ay, lz = x[2][2][i] - az;
            const float rx = x[3][0][i] - ax, ry = x[3][1][i] - ay, rz = x[3][2][i] - az;
            const float nx = ey * lz - ez * ly, ny = ez * lx - ex * lz, nz = ex * ly - ey * lx;
            const float ox = ry * ez - rz * ey, oy = rz * ex - rx * ez, oz = rx * ey - ry * ex;
            const float sine = (ny * oz - nz * oy) * ex + (nz * ox - nx * oz) * ey + (nx * oy - ny * ox) * ez;
            const float cosine = nx * ox + ny * oy + nz * oz;
            float ee = ex * ex + ey * ey + ez * ez, nn = nx * nx + ny * ny + nz * nz, oo = ox * ox + oy * oy + oz * oz;
            const float ll = lx * lx + ly * ly + lz * lz, rr = rx * rx + ry * ry + rz * rz;
            const float longest = ee > ll ? ee : ll, size = longest > rr ? longest : rr, area = nn < oo ? nn : oo;
            const float bent = area > SLIVER * SLIVER * size * size ? 1.0f : 0.0f;
            ee += 1.0f - bent, nn += 1.0f - bent, oo += 1.0f - bent; /* where it is flat they are nearly zero */
            const float length = ee * inverse_root(ee), angle = arc(sine, cosine * length) - f->angle[h + i];
            const float weight = bent * f->bend[h + i], torque = weight * ee * angle * length;
            const float longer = weight * angle * angle, u = -torque / nn, w = -torque / oo;
            const float p = (lx * ex + ly * ey + lz * ez) / ee, q = (rx * ex + ry * ey + rz * ez) / ee;
            const float sx = p * u * nx + q * w * ox, sy = p * u * ny + q * w * oy, sz = p * u * nz + q * w * oz;
            g[2][0][i] = u * nx, g[2][1][i] = u * ny, g[2][2][i] = u * nz;
            g[3][0][i] = w * ox, g[3][1][i] = w * oy, g[3][2][i] = w * oz;
            g[1][0][i] = longer * ex - sx, g[1][1][i] = longer * ey - sy, g[1][2][i] = longer * ez - sz;
            g[0][0][i] = sx - u * nx - w * ox - longer * ex;
            g[0][1][i] = sy - u * ny - w * oy - longer * ey;
            g[0][2][i] = sz - u * nz - w * oz - longer * ez;
        }
        scatter(force, wide, f->hinge + h, count, 4, g);
    }
}

/* What the layers of the decoder give before each ReLU, for a code, in s->read. */
static void read_code(const psi_model *m, psi_state *s) {
    float *x = s->rows[0];
    first_of_decoder(m, s, s->read[0], x);
    for (int32_t l = 0; l < m->decoder; l++) {
        const int32_t inputs = m->decode[l].inputs;
        if (l + 1 == m->decoder && !m->relu) break; /* the weights themselves have no ReLU */
        memcpy(x, s->read[l], inputs * sizeof(float));
        relu(x, inputs);
        dense(&m->decode[l], x, s->read[l + 1], s);
    }
    for (int32_t i = 0; m->relu && m->skip && i < m->decode[m->decoder - 1].outputs; i++)
        s->read[m->decoder][i] += s->read[0][m->decode[0].inputs + i];
}

static void masked(float *g, const float *before, int32_t count) {
    for (int32_t i = 0; i < count; i++) g[i] = before[i] > 0.0f ? g[i] : 0.0f;
}

/* Forces on vertices, pulled back to whitened codes, in s->pulled. */
static void pull_back(const psi_model *m, psi_state *s) {
    const forces *f = &m->f;
    const size_t count = f->vertices, wide = padded(f->vertices);
    const int32_t first = m->decode[0].inputs, last = m->decode[m->decoder - 1].outputs;
    float *canonical[KINDS], *other[KINDS], *weights[KINDS];
    read_code(m, s);
    for (int k = 0; k < KINDS; k++) {
        const float *push = s->force + 3 * k * wide;
        canonical[k] = s->rows[k];
        for (int b = 0; b < 3; b++) {
            const float *r = s->blended + b * wide;
            for (size_t v = 0; v < count; v++)
                canonical[k][b * count + v] =
                    r[v] * push[v] + r[4 * wide + v] * push[wide + v] + r[8 * wide + v] * push[2 * wide + v];
        }
        weights[k] = s->pulled[k];
    }
    dense_kinds(&f->unshape, canonical, weights, s);
    if (m->mixed) {
        dense_kinds(&f->unmix, weights, canonical, s);
        for (int k = 0; k < KINDS; k++) memcpy(weights[k], canonical[k], last * sizeof(float));
    }
    for (int k = 0; k < KINDS; k++) {
        if (m->relu) masked(weights[k], s->read[m->decoder], last);
        /* the skip's part waits behind that of the decoder */
        other[k] = s->pulled[k] + m->widest;
        memcpy(other[k], weights[k], last * sizeof(float));
    }
    for (int32_t l = m->decoder - 1; l >= 0; l--) {
        dense_kinds(&f->undecode[l], other, canonical, s);
        for (int k = 0; k < KINDS; k++) {
            masked(canonical[k], s->read[l], m->decode[l].inputs);
            memcpy(other[k], canonical[k], m->decode[l].inputs * sizeof(float));
        }
    }
    for (int k = 0; k < KINDS; k++) {
        memcpy(canonical[k], other[k], first * sizeof(float));
        if (m->skip) memcpy(canonical[k] + first, weights[k], last * sizeof(float));
    }
    dense_kinds(&f->unread.coarse, canonical, weights, s);
    dense_kinds(&f->unread.fine, canonical, other, s);
    for (int k = 0; k < KINDS; k++)
        for (int32_t i = 0; i < m->code; i++) s->pulled[k][i] += other[k][i];
}

/* BOUND tanh of scaled inputs to 1e-6, with an exponential that has no branch. */
static void soften(float *restrict x, const float *restrict middle, const float *restrict inverse, int32_t count) {
    for (int32_t i = 0; i < count; i++) {
        float y = (x[i] - middle[i]) * inverse[i];
        y = y > -9.0f ? (y < 9.0f ? y : 9.0f) : -9.0f;
        const float p = y * 2.88539008f, whole = (float)(int32_t)(p + (p < 0.0f ? -0.5f : 0.5f)),
                    t = (p - whole) * 0.693147181f;
        float e = 1.0f + t * (1.0f + t * (0.5f + t * (0.166666667f + t * (0.0416666667f + t * (0.00833333333f +
                  t * 0.00138888889f)))));
        int32_t bits;
        memcpy(&bits, &e, sizeof bits);
        bits += (int32_t)whole * (1 << 23);
        memcpy(&e, &bits, sizeof e);
        x[i] = BOUND * (e - 1.0f) / (e + 1.0f);
    }
}

/* Counts a frame for which the body stands still, or begins to count again; the share that is left of a change. */
static float awake(const psi_model *m, psi_state *s) {
    const size_t size = 9 * (size_t)m->joints;
    int still = 1;
    for (size_t i = 0; i < size; i++) still &= fabsf(s->rotations[i] - s->rotations[size + i]) < STILL;
    for (int c = 0; c < 3; c++)
        still &= fabsf(s->translation[c] - s->translation[3 + c]) < STILL && s->external[c] == 0.0f;
    s->still = still ? s->still + 1.0f : 0.0f;
    return s->still > AWAKE ? powf(SLOWING, s->still - AWAKE) : 1.0f;
}

/* The next code from the forces on the held garment at the new pose, in s->next; and what is touched, if `shown`. */
static void predict_from_forces(const psi_model *m, psi_state *s, int shown) {
    const forces *f = &m->f;
    const size_t wide = padded(f->vertices);
    const int32_t code = m->code;
    float advance[3], *x = s->inputs, *y = s->rows[0], *z = s->rows[1], *elastic = s->force + 3 * wide;
    for (int c = 0; c < 3; c++) advance[c] = s->translation[c] - s->translation[3 + c];
    blend(m, s, f->weight, f->vertices, s->blended);
    apply(s->blended, s->garment, advance, wide, s->held);
    pose_body(m, s, advance);
    push_momentum(m, s, s->force);
    memset(elastic, 0, 3 * wide * sizeof(float));
    push_stretching(&f->felt, s->held, elastic);
    push_bending(f, s->held, elastic);
    const int32_t edge_clusters = shown ? f->edge_clusters : 0;
    if (edge_clusters) find_middles(f, s);
    find_nearest(m, s, edge_clusters);
    find_planes(m, s, s->nearest, wide, s->plane);
    if (edge_clusters) find_planes(m, s, s->nearest_between, padded(f->edges), s->plane_between);
    raise_planes(m, s);
    push_contact(m, s, s->force + 6 * wide);
    pull_back(m, s);
    memcpy(x, s->latent, code * sizeof(float));
    dense_exact(&f->change, s->change, x + code, y, s);
    for (int k = 0; k < KINDS; k++) memcpy(x + (2 + k) * code, s->pulled[k], code * sizeof(float));
    float sum = 0.0f; /* NaN if one of them is */
    for (int32_t i = 0; i < (2 + KINDS) * code; i++) sum += 0.0f * x[i];
    soften(x, f->middle, f->inverse_spread, (2 + KINDS) * code);
    dense(&f->first, x, y, s);
    const int32_t width = f->first.outputs - code;
    memcpy(s->next, y + width, code * sizeof(float)); /* the linear path */
    for (int32_t l = 0; l < m->hidden; l++) {
        relu(y, m->then[l].inputs);
        dense(&m->then[l], y, z, s);
        float *swap = y;
        y = z, z = swap;
    }
    const int gated = m->then[m->hidden - 1].outputs > code;
    for (int k = 0; k < (gated ? 2 + KINDS : 1); k++)
        for (int32_t i = 0; i < code; i++) s->next[i] += gated ? y[k * code + i] * x[k * code + i] : y[i];
    dense_exact(&f->move, s->next, z, y, s);
    const float share = awake(m, s);
    for (int32_t i = 0; i < code; i++) s->next[i] = s->latent[i] + share * z[i] + sum;
}

/* One step of relaxation of a garment [3][vertices] that was `last` before, with as much room to `push` in:
   relaxation.relaxed. */
static void ease(const fabric *f, float momentum, float *x, float *last, float *push) {
    const size_t wide = padded(f->vertices);
    memset(push, 0, 3 * wide * sizeof(float));
    push_stretching(f, x, push);
    for (size_t i = 0; i < wide; i++) {
        const float mobility = (1.0f + momentum) * f->mobility[i];
        float move[3] = {mobility * push[i], mobility * push[wide + i], mobility * push[2 * wide + i]};
        const float square = move[0] * move[0] + move[1] * move[1] + move[2] * move[2],
                    share = 1.0f / sqrtf(1.0f + square / (LONGEST * LONGEST));
        for (int c = 0; c < 3; c++) {
            const float now = x[c * wide + i];
            x[c * wide + i] = now + share * move[c] + momentum * (now - last[c * wide + i]);
            last[c * wide + i] = now;
        }
    }
}

static void ease_all(const fabric *of, float *x, float *last, float *push) {
    memcpy(last, x, 3 * (size_t)padded(of->vertices) * sizeof(float));
    for (int32_t n = 0; n < of->steps; n++) ease(of, of->momentum, x, last, push);
}

/* Adds to `canonical` what s->held has moved by from `before`, carried back: skinning.unapply_direction. */
static void carry_back(const forces *f, const psi_state *s, const float *before, float *canonical) {
    const size_t wide = padded(f->vertices);
    for (size_t i = 0; i < wide; i++) {
        float column[3][3], moved[3], back[3], size = 0.0f; /* Cramer's rule */
        for (int c = 0; c < 3; c++) {
            moved[c] = s->held[c * wide + i] - before[c * wide + i];
            for (int k = 0; k < 3; k++) column[k][c] = s->blended[(4 * c + k) * wide + i];
        }
        for (int k = 0; k < 3; k++) {
            const float *p = column[(k + 1) % 3], *q = column[(k + 2) % 3];
            const float normal[3] = {p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]};
            back[k] = normal[0] * moved[0] + normal[1] * moved[1] + normal[2] * moved[2];
            if (k == 0) size = normal[0] * column[0][0] + normal[1] * column[0][1] + normal[2] * column[0][2];
        }
        size = fabsf(size) < FLAT ? (size < 0.0f ? -FLAT : FLAT) : size;
        for (int c = 0; c < 3; c++) canonical[c * wide + i] += back[c] / size;
    }
}

/* Relaxes the garment that is posed in s->held: drape._hung. What it moves by stays in the last rows of s->force, for
   what is shown. */
static void relax(const forces *f, psi_state *s) {
    const size_t wide = padded(f->vertices);
    float *before = s->force + 3 * wide, *canonical = s->force + 6 * wide;
    memcpy(before, s->held, 3 * wide * sizeof(float));
    ease_all(&f->felt, s->held, s->eased, s->force);
    carry_back(f, s, before, canonical);
    for (size_t i = 0; i < 3 * wide; i++) s->garment[i] += canonical[i];
}

/* How the garment hangs after a step; the code before it is in s->next. */
static void drape(const psi_model *m, psi_state *s) {
    const forces *f = &m->f;
    const size_t count = f->vertices, wide = padded(f->vertices);
    const float *garment = decode(m, s, m->apart ? &f->felt_shapes : &m->shapes), still[3] = {0, 0, 0};
    for (int c = 0; c < 3; c++) memcpy(s->garment + c * wide, garment + c * count, count * sizeof(float));
    apply(s->blended, s->garment, still, wide, s->held);
    memset(s->force + 6 * wide, 0, 3 * wide * sizeof(float));
    if (f->felt.steps) relax(f, s);
    for (int c = 0; c < 3; c++) {
        const float advance = s->translation[c] - s->translation[3 + c];
        float *x = s->position + c * wide, *v = s->velocity + c * wide, *now = s->held + c * wide;
        for (size_t i = 0; i < wide; i++) v[i] = now[i] + advance - x[i], x[i] = now[i];
    }
    for (int32_t i = 0; i < m->code; i++) s->change[i] = s->latent[i] - s->next[i];
}

/* How far positions [3][wide] are from planes [4][wide]; `advance` leads to them from the last root. */
static inline float gap_of(const float *plane, const float *x, size_t wide, size_t v, const float *advance) {
    plane += v, x += v;
    return plane[0] * (x[0] + advance[0]) + plane[wide] * (x[wide] + advance[1]) +
           plane[2 * wide] * (x[2 * wide] + advance[2]) - plane[3 * wide];
}

/* How far outside of planes positions [3][wide] are pushed: to `target`, and by `deepest` at most. */
static void find_targets(const forces *f, const float *plane, const float *x, size_t wide, const float *advance,
                         float *target) {
    for (size_t v = 0; v < wide; v++) {
        const float farthest = gap_of(plane, x, wide, v, advance) + f->deepest;
        target[v] = farthest < target[v] ? farthest : target[v];
    }
}

static inline float limited(float depth, float most) { return depth > 0.0f ? (depth < most ? depth : most) : 0.0f; }

/* Pushes the ends of edges as their middles are to be pushed: contact_search.edges_pushed_out. */
static void push_edges(const forces *f, psi_state *s, const float *advance) {
    const size_t wide = padded(f->vertices), edges = padded(f->edges);
    float *total = s->force; /* [3], and how many edges push */
    find_middles(f, s);
    memset(total, 0, 4 * wide * sizeof(float));
    for (int32_t first = 0; first < f->edges; first += LANES) {
        const int32_t count = f->edges - first < LANES ? f->edges - first : LANES;
        float push[LANES];
        for (int i = 0; i < LANES; i++) {
            const float gap = gap_of(s->plane_between, s->between, edges, first + i, advance);
            push[i] = limited(s->target_between[first + i] - gap, f->deepest);
        }
        for (int i = 0; i < count; i++) {
            if (push[i] == 0.0f) continue;
            for (int end = 0; end < 2; end++) {
                float *sum = total + f->edge[end * edges + first + i];
                for (int c = 0; c < 3; c++) sum[c * wide] += push[i] * s->plane_between[c * edges + first + i];
                sum[3 * wide] += 1.0f;
            }
        }
    }
    for (size_t v = 0; v < wide; v++)
        for (int c = 0; c < 3; c++)
            s->held[c * wide + v] += total[c * wide + v] / (total[3 * wide + v] > 1.0f ? total[3 * wide + v] : 1.0f);
}

/* Pushes the garment in s->held out of what it touches, vertices last. */
static void push_held(const forces *f, psi_state *s, const float *advance) {
    const size_t wide = padded(f->vertices);
    if (f->edge_clusters) push_edges(f, s, advance);
    for (int32_t v = 0; v < f->vertices; v++) {
        const float push = limited(s->target[v] - gap_of(s->plane, s->held, wide, v, advance), f->deepest);
        for (int c = 0; c < 3; c++) s->held[c * wide + v] += push * s->plane[c * wide + v];
    }
}

/* Pushes the garment in s->held out of the body and relaxes it, in turn: drape.shown_outside. */
static void lift(const psi_model *m, psi_state *s) {
    const forces *f = &m->f;
    const size_t wide = padded(f->vertices), edges = padded(f->edges);
    float advance[3], *canonical = s->force + 6 * wide;
    for (int c = 0; c < 3; c++) advance[c] = s->translation[c] - s->translation[3 + c];
    for (size_t v = 0; v < wide; v++) s->target[v] = f->offset;
    find_targets(f, s->plane, s->held, wide, advance, s->target);
    if (f->edge_clusters) find_middles(f, s);
    if (f->edge_clusters) find_targets(f, s->plane_between, s->between, edges, advance, s->target_between);
    for (int32_t n = 0; n < f->felt.steps; n++) {
        push_held(f, s, advance);
        ease(&f->felt, 0.0f, s->held, s->eased, s->force);
    }
    push_held(f, s, advance);
    if (m->apart) carry_back(f, s, s->position, canonical); /* what is shown takes part in it */
}

/* The garment that is shown where another feels: it takes part in how that one is relaxed. */
static const float *decode_apart(const psi_model *m, psi_state *s) {
    const size_t count = m->vertices, rows = padded(m->vertices), wide = padded(m->f.vertices);
    const float *moved = s->force + 6 * wide;
    float *garment = decode(m, s, &m->shapes);
    for (int c = 0; c < 3; c++)
        for (size_t v = 0; v < count; v++)
            for (int k = 0; k < 3; k++)
                garment[c * count + v] += m->f.share[k * rows + v] * moved[c * wide + m->f.around[k * rows + v]];
    return garment;
}

static void show(const psi_model *m, const psi_state *s, float *vertices) {
    const size_t count = m->f.vertices, wide = padded(m->f.vertices);
    for (size_t v = 0; v < count; v++)
        for (int c = 0; c < 3; c++) vertices[3 * v + c] = s->held[c * wide + v] + s->translation[c];
}

/* Pushes vertices [vertices][3] that are shown, but do not feel, out of the planes of those that do. */
static void push_out(const psi_model *m, const psi_state *s, float *vertices) {
    const float *last = s->translation + 3;
    const size_t wide = padded(m->f.vertices);
    for (int32_t v = 0; v < m->vertices; v++) {
        const float *plane = s->plane + m->f.around[v];
        float *x = vertices + 3 * v, gap = -plane[3 * wide];
        for (int c = 0; c < 3; c++) gap += plane[c * wide] * (x[c] - last[c]);
        const float push = limited(s->target[m->f.around[v]] - gap, m->f.deepest);
        for (int c = 0; c < 3; c++) x[c] += push * plane[c * wide];
    }
}

/* The planes of vertices in s->shown, relative to the last root: the nearest beside each, drape._nearest_beside. */
static void find_planes_shown(const psi_model *m, psi_state *s) {
    const forces *f = &m->f;
    const size_t wide = padded(f->vertices), edges = padded(f->edges), rows = padded(m->vertices),
                 faces = padded(f->faces);
    for (size_t v = 0; v < rows; v++) {
        float least = INFINITY;
        for (int k = 0; k < f->besides; k++) {
            const int32_t beside = f->beside[k * rows + v], edge = beside - f->vertices;
            if (edge >= 0 && s->target_between[edge] < 0.0f) continue; /* it touches none */
            const int32_t face = edge < 0 ? s->nearest[beside] : s->nearest_between[edge];
            float apart = 0.0f;
            for (int c = 0; c < 3; c++) {
                const float d = s->centre[c * faces + face] - s->shown[c * rows + v];
                apart += d * d;
            }
            if (!(apart < least)) continue;
            least = apart;
            const float *plane = edge < 0 ? s->plane + beside : s->plane_between + edge;
            for (int c = 0; c < 4; c++) s->plane_shown[c * rows + v] = plane[c * (edge < 0 ? wide : edges)];
        }
    }
}

/* Raises them as raise_planes does, RAISED times as far. */
static void raise_planes_shown(const psi_model *m, psi_state *s) {
    const fabric *shown = &m->f.shown;
    const size_t rows = padded(m->vertices), triangles = padded(shown->triangles);
    float *raised = s->moved;
    memset(raised, 0, rows * sizeof(float));
    for (int32_t t = 0; t < shown->triangles; t++)
        for (int k = 0; k < 3; k++) {
            const int32_t a = shown->corner[k * triangles + t], b = shown->corner[(k + 1) % 3 * triangles + t];
            float bulge = 0.0f;
            for (size_t c = 0; c < 3 * rows; c += rows)
                bulge += (s->plane_shown[c + a] - s->plane_shown[c + b]) * (s->shown[c + a] - s->shown[c + b]);
            bulge = bulge / 8 < m->f.highest ? bulge / 8 : m->f.highest;
            if (raised[a] < bulge) raised[a] = bulge;
            if (raised[b] < bulge) raised[b] = bulge;
        }
    for (size_t v = 0; v < rows; v++) s->plane_shown[3 * rows + v] += RAISED * raised[v];
}

static void push_shown(const psi_model *m, psi_state *s) {
    const size_t rows = padded(m->vertices);
    const float nowhere[3] = {0};
    for (size_t v = 0; v < rows; v++) {
        const float push = limited(s->aim[v] - gap_of(s->plane_shown, s->shown, rows, v, nowhere), m->f.deepest);
        for (int c = 0; c < 3; c++) s->shown[c * rows + v] += push * s->plane_shown[c * rows + v];
    }
}

/* Relaxes vertices [vertices][3], then pushes them out of the body and relaxes them in turn, with the planes that are
   nearest as each round begins: drape._relaxed_outside. */
static void lift_shown(const psi_model *m, psi_state *s, float *vertices) {
    const float *last = s->translation + 3;
    const size_t rows = padded(m->vertices);
    for (int32_t v = 0; v < m->vertices; v++)
        for (int c = 0; c < 3; c++) s->shown[c * rows + v] = vertices[3 * v + c] - last[c];
    ease_all(&m->f.shown, s->shown, s->eased, s->moved);
    const float nowhere[3] = {0};
    for (int32_t k = 0; k < m->f.rounds; k++) {
        find_planes_shown(m, s);
        raise_planes_shown(m, s);
        for (size_t v = 0; v < rows; v++) s->aim[v] = m->f.offset;
        find_targets(&m->f, s->plane_shown, s->shown, rows, nowhere, s->aim);
        memcpy(s->eased, s->shown, 3 * rows * sizeof(float));
        for (int32_t n = 0; n < m->f.turns; n++) {
            push_shown(m, s);
            ease(&m->f.shown, m->f.turning, s->shown, s->eased, s->moved);
        }
        push_shown(m, s);
    }
    for (int32_t v = 0; v < m->vertices; v++)
        for (int c = 0; c < 3; c++) vertices[3 * v + c] = s->shown[c * rows + v] + last[c];
}

/* Lets the garment hang on a body that stands. */
static void settle(const psi_model *m, psi_state *s) {
    const size_t wide = padded(m->f.vertices);
    bones(m, s);
    blend(m, s, m->f.weight, m->f.vertices, s->blended);
    memcpy(s->next, s->latent, m->code * sizeof(float));
    drape(m, s);
    memset(s->velocity, 0, 3 * wide * sizeof(float));
    for (int i = 0; i < SETTLING; i++) psi_step(m, s, s->rotations, s->translation, NULL);
}

static void older(float *rows, size_t size) { memmove(rows + size, rows, 2 * size * sizeof(float)); }

int psi_step(const psi_model *m, psi_state *s, const float *rotations, const float *translation, float *vertices) {
    const size_t joints = m->joints;
    const int finite = sound(m, rotations, translation);
    older(s->rotations, 9 * joints);
    older(s->positions, 3 * joints);
    older(s->translation, 3);
    if (finite) { /* else the newest pose remains */
        memmove(s->rotations, rotations, 9 * joints * sizeof(float)); /* it may be its own */
        memmove(s->translation, translation, 3 * sizeof(float));
    }
    kinematics(m, s->rotations, s->global, s->positions);
    bones(m, s);
    int ordinary = 1;
    if (m->forced) {
        predict_from_forces(m, s, vertices != NULL);
    } else {
        pose_inputs(m, s, s->inputs);
        for (int32_t i = 0; i < m->pose.inputs; i++) s->inputs[i] -= m->pose_mean[i];
        ordinary = clamp(s->inputs, &m->pose_bounds, m->pose.inputs);
        predict(m, s);
    }
    const int inside = clamp(s->next, &m->code_bounds, m->code);
    float *swap = s->latent;
    s->latent = s->next, s->next = swap;
    if (m->forced) drape(m, s);
    if (vertices && m->forced && !m->alone) lift(m, s);
    if (vertices && m->forced && !m->apart) {
        show(m, s, vertices);
    } else if (vertices && m->alone) {
        skin(m, s, decode(m, s, &m->shapes), vertices);
        lift_shown(m, s, vertices);
    } else if (vertices) {
        skin(m, s, m->forced ? decode_apart(m, s) : decode(m, s, &m->shapes), vertices);
    }
    if (vertices && m->apart && !m->alone) push_out(m, s, vertices);
    s->outside = (finite && s->pushed ? 0 : PSI_NOT_FINITE) | (ordinary ? 0 : PSI_POSE) | (m->known ? 0 : PSI_WEARER) |
                 (inside ? 0 : PSI_CODE);
    return s->outside == 0;
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
    s->fixed = (int16_t *)part(room, &used, KINDS * m->longest / 2);
    if (!m->forced) return used;
    const size_t vertices = padded(m->f.vertices);
    s->change = part(room, &used, m->code);
    s->garment = part(room, &used, 3 * vertices);
    s->position = part(room, &used, 3 * vertices);
    s->velocity = part(room, &used, 3 * vertices);
    s->held = part(room, &used, 3 * vertices);
    s->blended = part(room, &used, 12 * vertices);
    s->force = part(room, &used, 3 * KINDS * vertices);
    s->patch = part(room, &used, 4 * (size_t)padded(m->f.faces / PATCH));
    s->near = (int8_t *)part(room, &used, padded(m->f.faces / PATCH) / sizeof(float));
    s->nearest = (int32_t *)part(room, &used, vertices);
    s->plane = part(room, &used, 4 * vertices);
    s->raised = part(room, &used, vertices);
    s->target = part(room, &used, vertices);
    const size_t alone = m->alone ? padded(m->vertices) : 0;
    s->shown = part(room, &used, 3 * alone);
    s->moved = part(room, &used, 3 * alone);
    s->plane_shown = part(room, &used, 4 * alone);
    s->aim = part(room, &used, alone);
    s->eased = part(room, &used, 3 * (alone > vertices ? alone : vertices));
    const size_t edges = m->f.edge_clusters ? padded(m->f.edges) : 0;
    s->between = part(room, &used, 3 * edges);
    s->nearest_between = (int32_t *)part(room, &used, edges);
    s->plane_between = part(room, &used, 4 * edges);
    s->target_between = part(room, &used, edges);
    s->body = part(room, &used, 3 * (size_t)padded(m->f.body));
    s->centre = part(room, &used, 3 * (size_t)padded(m->f.faces));
    for (int k = 0; k < KINDS; k++) s->pulled[k] = part(room, &used, 2 * (size_t)m->widest);
    for (int32_t i = 0; i <= m->decoder; i++) s->read[i] = part(room, &used, m->widest);
    return used;
}

psi_state *psi_blank(const psi_model *m) {
    psi_state empty, *s = calloc(1, sizeof *s);
    if (s) s->memory = calloc(arrange(m, &empty, NULL) * sizeof(float) + ALIGN, 1);
    if (!s || !s->memory) {
        free(s);
        return NULL;
    }
    arrange(m, s, (float *)aligned(s->memory));
    s->pushed = 1;
    return s;
}

psi_state *psi_begin(const psi_model *m, const float *rotations, const float *translation) {
    const size_t joints = m->joints;
    psi_state *s = psi_blank(m);
    if (!s) return NULL;
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
    if (m->forced) settle(m, s);
    return s;
}

void psi_end(psi_state *s) {
    if (s) free(s->memory);
    free(s);
}

int psi_outside(const psi_state *s) { return s->outside; }

int psi_push(const psi_model *m, psi_state *s, const float *external) {
    s->pushed = 1;
    for (int c = 0; c < 3; c++) s->pushed &= fabsf(external[c]) <= FLT_MAX;
    for (int c = 0; c < 3; c++) s->external[c] = s->pushed ? external[c] : 0.0f;
    return m->forced != 0;
}

int psi_carried(const psi_model *m) {
    return m->code + 24 * m->joints + 6 + (m->forced ? m->code + 9 * m->f.vertices + 1 : 0);
}

/* Rows [3][vertices] as they are carried: as they are, or one vertex after the other. */
static float *put_rows(const forces *f, const float *rows, int whole, float *to) {
    const size_t count = f->vertices, wide = padded(f->vertices);
    for (size_t v = 0; v < count; v++)
        for (int c = 0; c < 3; c++) to[whole ? c * count + v : 3 * v + c] = rows[c * wide + v];
    return to + 3 * count;
}

static const float *take_rows(const forces *f, float *rows, int whole, const float *from) {
    const size_t count = f->vertices, wide = padded(f->vertices);
    for (size_t v = 0; v < count; v++)
        for (int c = 0; c < 3; c++) rows[c * wide + v] = from[whole ? c * count + v : 3 * v + c];
    return from + 3 * count;
}

void psi_keep(const psi_model *m, const psi_state *s, float *carried) {
    memcpy(carried, s->latent, m->code * sizeof(float));
    memcpy(carried += m->code, s->rotations, 18 * m->joints * sizeof(float));
    memcpy(carried += 18 * m->joints, s->positions, 6 * m->joints * sizeof(float));
    memcpy(carried += 6 * m->joints, s->translation, 6 * sizeof(float));
    if (!m->forced) return;
    memcpy(carried += 6, s->change, m->code * sizeof(float));
    carried = put_rows(&m->f, s->garment, 1, carried + m->code);
    *put_rows(&m->f, s->velocity, 0, put_rows(&m->f, s->position, 0, carried)) = s->still;
}

void psi_put_back(const psi_model *m, psi_state *s, const float *carried) {
    memcpy(s->latent, carried, m->code * sizeof(float));
    memcpy(s->rotations, carried += m->code, 18 * m->joints * sizeof(float));
    memcpy(s->positions, carried += 18 * m->joints, 6 * m->joints * sizeof(float));
    memcpy(s->translation, carried += 6 * m->joints, 6 * sizeof(float));
    if (!m->forced) return;
    memcpy(s->change, carried += 6, m->code * sizeof(float));
    carried = take_rows(&m->f, s->garment, 1, carried + m->code);
    s->still = *take_rows(&m->f, s->velocity, 0, take_rows(&m->f, s->position, 0, carried));
}
