/* Psi in plain C: one frame of a garment, from the pose of its wearer to its vertices.
 *
 * `python -m clothjax convert RUN --to c` writes a GARMENT.psi, this file and psi.c. C99 and nothing else; made with
 *
 *     cc -O3 -march=native -c psi.c
 *
 * a compiler turns the loops into the vector instructions that a processor has. Rotations are 3 x 3 matrices, row
 * by row, local to the parent joint, the identity in the body's canonical pose; the translation is that of the root
 * from its canonical place. All lengths are metres, up is +Y. The JSON beside a GARMENT.psi names the joints.
 */
#ifndef PSI_H
#define PSI_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct psi_model psi_model; /* a garment on a wearer: only read, by as many threads as there are */
typedef struct psi_state psi_state; /* of one character: what goes on from frame to frame, and room to compute */

/* NULL where the file cannot be read, and then what is wrong with it in `error`, unless that is NULL. */
psi_model *psi_load(const char *path, const char **error);
/* The same of a file that is in memory already, at a multiple of 4, better of 64: it has to stay there. */
psi_model *psi_open(const void *bytes, size_t size, const char **error);
void psi_free(psi_model *model);

int psi_joints(const psi_model *model);
int psi_vertices(const psi_model *model);
float psi_fps(const psi_model *model);

/* The state of a character that has been standing in a pose, rotations [joints][9], translation [3]; NULL without
 * memory. A garment with forces has settled. */
psi_state *psi_begin(const psi_model *model, const float *rotations, const float *translation);
/* A state without any pose, which psi_put_back has to fill; NULL without memory. */
psi_state *psi_blank(const psi_model *model);
void psi_end(psi_state *state);

/* An acceleration of the cloth beside gravity, external [3] m/s^2, such as wind, in all frames to come; one that is not
 * finite does not push. Whether the model feels it: only one with forces does. */
int psi_push(const psi_model *model, psi_state *state, const float *external);

/* The next frame: vertices [vertices][3] in the world, or NULL for a garment that nobody sees. It takes no memory.
 * 0 where the pose, the wearer or the code was out of the range of training and was brought into it. */
int psi_step(const psi_model *model, psi_state *state, const float *rotations, const float *translation,
             float *vertices);

/* What of the last frame was out of the range of training: the sum of these, 0 for nothing. */
enum { PSI_NOT_FINITE = 1, PSI_POSE = 2, PSI_WEARER = 4, PSI_CODE = 8 };
int psi_outside(const psi_state *state);

/* What of a state goes on from frame to frame, psi_carried() floats, to be kept and put back: the code, then of the last
 * two poses, newest first, the rotations, the joints' positions [2][joints][3] and the translations. With forces, then
 * the change of the code, the canonical garment [3][vertices], its positions and velocities [vertices][3], and the frames
 * for which the body has stood still. */
int psi_carried(const psi_model *model);
void psi_keep(const psi_model *model, const psi_state *state, float *carried);
void psi_put_back(const psi_model *model, psi_state *state, const float *carried);

#ifdef __cplusplus
}
#endif
#endif
