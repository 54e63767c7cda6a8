/* A garment in plain C, as an engine drives it: one call a frame.
 *
 *     cc -O3 -march=native -I FOLDER play.c FOLDER/psi.c -lm -o play
 *     ./play FOLDER/tshirt.psi motion.bin vertices.bin
 *
 * FOLDER is where `clothjax convert --to c` has written. motion.bin has for every frame the rotations [joints][9]
 * and the translation [3] as float32. Vertices [frames][vertices][3] are written as float32; the median time of a frame
 * is printed.
 */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "psi.h"

static double microseconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return 1e6 * now.tv_sec + 1e-3 * now.tv_nsec;
}

static int order(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static int fail(const char *what, const char *why) {
    fprintf(stderr, "%s: %s\n", what, why);
    return 1;
}

int main(int count, char **arguments) {
    if (count != 4) return fail(arguments[0], "GARMENT.psi motion.bin vertices.bin");
    const char *error;
    psi_model *model = psi_load(arguments[1], &error);
    if (!model) return fail(arguments[1], error);
    FILE *motion = fopen(arguments[2], "rb"), *out = fopen(arguments[3], "wb");
    if (!motion || !out) return fail(motion ? arguments[3] : arguments[2], "cannot be opened");

    const size_t turns = 9 * (size_t)psi_joints(model), size = 3 * (size_t)psi_vertices(model);
    float *pose = malloc((turns + 3) * sizeof *pose), *vertices = malloc(size * sizeof *vertices);
    if (!pose || !vertices) return fail(arguments[1], "no memory");
    double *taken = NULL;
    psi_state *character = NULL;
    size_t frames = 0;
    while (fread(pose, sizeof *pose, turns + 3, motion) == turns + 3) {
        if (!character) character = psi_begin(model, pose, pose + turns);
        taken = realloc(taken, (frames + 1) * sizeof *taken);
        if (!character || !taken) return fail(arguments[1], "no memory");
        const double began = microseconds();
        psi_step(model, character, pose, pose + turns, vertices);
        taken[frames++] = microseconds() - began;
        if (fwrite(vertices, sizeof *vertices, size, out) != size) return fail(arguments[3], "cannot be written");
    }
    if (!frames) return fail(arguments[2], "has no whole frame");
    qsort(taken, frames, sizeof *taken, order);
    printf("%.1f us a frame, one thread\n", taken[frames / 2]);
    psi_end(character);
    psi_free(model);
    free(taken), free(vertices), free(pose), fclose(motion);
    return fclose(out) ? fail(arguments[3], "cannot be written") : 0;
}
