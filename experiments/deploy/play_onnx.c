/* A garment in ONNX Runtime, as an engine in C or C++ drives it: one call a frame, tensors in buffers of its own.
 *
 *     cc -O2 -I HEADERS play_onnx.c -L LIBRARIES -lonnxruntime -o play_onnx
 *     ./play_onnx tshirt.onnx motion.bin vertices.bin
 *
 * Beside tshirt.onnx lies tshirt.json, which clothjax convert wrote. motion.bin has for every frame the rotations
 * [joints][9] and the translation [3] as float32. Vertices [frames][vertices][3] are written as float32; the median time
 * of a frame on one thread is printed.
 */
#define _POSIX_C_SOURCE 199309L
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "onnxruntime_c_api.h"

enum { LATENT, HISTORY, ROTATIONS, TRANSLATION, INPUTS, CHANGE = INPUTS, GARMENT, POSITION, MORE = 6 };
enum { NEXT_LATENT, NEXT_HISTORY, OK, OUTPUTS = 4 };
/* a garment with forces has five more arrays in its state, and is pushed by an external acceleration */
static const char *const inputs[INPUTS + MORE] = {"latent", "history", "rotations", "translation", "change", "garment",
                                                  "position", "velocity", "still", "external"};
static const char *const plain[OUTPUTS] = {"next_latent", "next_history", "ok", "vertices"};
static const char *const forced[OUTPUTS + MORE - 1] = {"next_latent", "next_history", "ok", "next_change",
                                                       "next_garment", "next_position", "next_velocity", "next_still", "vertices"};

static const OrtApi *ort;

static void fail(const char *what, const char *why) {
    fprintf(stderr, "%s: %s\n", what, why);
    exit(1);
}

static void check(OrtStatus *status) {
    if (status) fail("ONNX Runtime", ort->GetErrorMessage(status));
}

typedef struct {
    OrtValue *value;
    void *data;
    size_t bytes;
} tensor;

static tensor make(const OrtTypeInfo *type, const OrtMemoryInfo *memory) {
    const OrtTensorTypeAndShapeInfo *info;
    ONNXTensorElementDataType kind;
    int64_t shape[8];
    size_t rank, count;
    tensor t;
    check(ort->CastTypeInfoToTensorInfo(type, &info));
    check(ort->GetTensorElementType(info, &kind));
    check(ort->GetDimensionsCount(info, &rank));
    check(ort->GetDimensions(info, shape, rank));
    check(ort->GetTensorShapeElementCount(info, &count));
    t.bytes = count * (kind == ONNX_TENSOR_ELEMENT_DATA_TYPE_BOOL ? sizeof(bool) : sizeof(float));
    t.data = calloc(1, t.bytes);
    check(ort->CreateTensorWithDataAsOrtValue(memory, t.data, t.bytes, shape, rank, kind, &t.value));
    return t;
}

/* The numbers of an array in a JSON file. */
static void read_array(const char *path, const char *name, float *to, size_t count) {
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END)) fail(path, "cannot be opened: it lies beside the .onnx");
    const long size = ftell(file);
    char *text = calloc(1, (size_t)size + 1);
    rewind(file);
    if (fread(text, 1, (size_t)size, file) != (size_t)size) fail(path, "cannot be read");
    fclose(file);
    char *at = strstr(text, name);
    at = at ? strpbrk(at + strlen(name), "[0123456789") : NULL;
    if (at && *at != '[') at--; /* a number alone */
    for (size_t i = 0; i < count; i++) {
        char *end = at;
        if (at) to[i] = strtof(at + 1, &end);
        if (!at || end == at + 1) fail(path, "lacks part of the first state");
        at = end;
    }
    free(text);
}

/* The next state is that of the frame to come. */
static void go_on(tensor *in, const tensor *out, int forces) {
    memcpy(in[LATENT].data, out[NEXT_LATENT].data, in[LATENT].bytes);
    memcpy(in[HISTORY].data, out[NEXT_HISTORY].data, in[HISTORY].bytes);
    for (int i = 0; forces && i < MORE - 1; i++) memcpy(in[INPUTS + i].data, out[OK + 1 + i].data, in[INPUTS + i].bytes);
}

static double microseconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return 1e6 * now.tv_sec + 1e-3 * now.tv_nsec;
}

static int order(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int count, char **arguments) {
    if (count != 4) fail(arguments[0], "GARMENT.onnx motion.bin vertices.bin");
    OrtEnv *env;
    OrtSessionOptions *options;
    OrtSession *session;
    OrtMemoryInfo *memory;
    ort = OrtGetApiBase()->GetApi(ORT_API_VERSION);
    if (!ort) fail("ONNX Runtime", "the library is older than its header");
    check(ort->CreateEnv(ORT_LOGGING_LEVEL_WARNING, "psi", &env));
    check(ort->CreateSessionOptions(&options));
    check(ort->SetIntraOpNumThreads(options, 1));
    check(ort->CreateSession(env, arguments[1], options, &session));
    check(ort->CreateCpuMemoryInfo(OrtDeviceAllocator, OrtMemTypeDefault, &memory));

    size_t given_count, found_count;
    check(ort->SessionGetInputCount(session, &given_count));
    check(ort->SessionGetOutputCount(session, &found_count));
    const int forces = given_count == INPUTS + MORE, given_all = forces ? INPUTS + MORE : INPUTS;
    const int found_all = forces ? OUTPUTS + MORE - 1 : OUTPUTS;
    const char *const *outputs = forces ? forced : plain;
    if (given_count != (size_t)given_all || found_count != (size_t)found_all) fail(arguments[1], "is of another kind");
    tensor in[INPUTS + MORE], out[OUTPUTS + MORE - 1];
    const OrtValue *given[INPUTS + MORE];
    OrtValue *found[OUTPUTS + MORE - 1];
    for (int i = 0; i < given_all; i++) {
        OrtTypeInfo *type;
        check(ort->SessionGetInputTypeInfo(session, i, &type));
        in[i] = make(type, memory);
        given[i] = in[i].value;
    }
    for (int i = 0; i < found_all; i++) {
        OrtTypeInfo *type;
        check(ort->SessionGetOutputTypeInfo(session, i, &type));
        out[i] = make(type, memory);
        found[i] = out[i].value;
    }

    const size_t stem = strlen(arguments[1]) - strlen(".onnx");
    if (strlen(arguments[1]) < 6 || strcmp(arguments[1] + stem, ".onnx")) fail(arguments[1], "is not called .onnx");
    char *about = malloc(stem + sizeof ".json");
    sprintf(about, "%.*s.json", (int)stem, arguments[1]);
    FILE *motion = fopen(arguments[2], "rb"), *shown = fopen(arguments[3], "wb");
    if (!motion || !shown) fail(motion ? arguments[3] : arguments[2], "cannot be opened");

    double *taken = NULL;
    float settling = 0;
    size_t frames = 0;
    while (fread(in[ROTATIONS].data, in[ROTATIONS].bytes, 1, motion) == 1 &&
           fread(in[TRANSLATION].data, in[TRANSLATION].bytes, 1, motion) == 1) {
        if (!frames) { /* the character has been standing in the first pose: "first_state" in the JSON */
            const size_t half = in[HISTORY].bytes / 2;
            read_array(about, "\"first_latent\"", in[LATENT].data, in[LATENT].bytes / sizeof(float));
            check(ort->Run(session, NULL, inputs, given, given_all, outputs, found_all, found));
            memcpy(in[HISTORY].data, out[NEXT_HISTORY].data, half);
            memcpy((char *)in[HISTORY].data + half, out[NEXT_HISTORY].data, half);
            if (forces) {
                read_array(about, "\"settling\"", &settling, 1);
                for (int i = GARMENT; i <= POSITION; i++)
                    memcpy(in[i].data, out[OK + 1 + i - INPUTS].data, in[i].bytes);
            }
            for (int i = 0; i < (int)settling; i++) {
                check(ort->Run(session, NULL, inputs, given, given_all, outputs, found_all, found));
                go_on(in, out, forces);
            }
        }
        const double began = microseconds();
        check(ort->Run(session, NULL, inputs, given, given_all, outputs, found_all, found));
        go_on(in, out, forces);
        taken = realloc(taken, (frames + 1) * sizeof *taken);
        taken[frames++] = microseconds() - began;
        if (fwrite(out[found_all - 1].data, out[found_all - 1].bytes, 1, shown) != 1) fail(arguments[3], "cannot be written");
    }
    if (!frames) fail(arguments[2], "has no whole frame");
    qsort(taken, frames, sizeof *taken, order);
    printf("%.1f us a frame, one thread\n", taken[frames / 2]);
    if (fclose(shown)) fail(arguments[3], "cannot be written");
    return 0;
}
