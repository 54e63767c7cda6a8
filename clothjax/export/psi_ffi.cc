// psi.c as a function that XLA calls: see psi_ffi.py.
#include "psi.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

static ffi::Error Step(ffi::Buffer<ffi::U8> file, ffi::Buffer<ffi::F32> carried, ffi::Buffer<ffi::F32> rotations,
                       ffi::Buffer<ffi::F32> translation, ffi::Buffer<ffi::F32> external,
                       ffi::ResultBuffer<ffi::F32> next,
                       ffi::ResultBuffer<ffi::PRED> outside, ffi::ResultBuffer<ffi::F32> vertices) {
  const char *error = nullptr;
  psi_model *model = psi_open(file.typed_data(), file.element_count(), &error);
  if (!model) return ffi::Error::InvalidArgument(error);
  const size_t count = psi_carried(model), seen = vertices->element_count();
  const bool fits = carried.element_count() == count && next->element_count() == count &&
                    rotations.element_count() == 9 * (size_t)psi_joints(model) && translation.element_count() == 3 &&
                    external.element_count() == 3 &&
                    (seen == 0 || seen == 3 * (size_t)psi_vertices(model));
  psi_state *state = fits ? psi_blank(model) : nullptr;
  if (state) {
    psi_put_back(model, state, carried.typed_data());
    psi_push(model, state, external.typed_data());
    psi_step(model, state, rotations.typed_data(), translation.typed_data(), seen ? vertices->typed_data() : nullptr);
    for (int i = 0; i < 4; i++) outside->typed_data()[i] = psi_outside(state) >> i & 1;
    psi_keep(model, state, next->typed_data());
  }
  psi_end(state);
  psi_free(model);
  if (!fits) return ffi::Error::InvalidArgument("the state or the pose is of another garment");
  return state ? ffi::Error::Success() : ffi::Error(ffi::ErrorCode::kResourceExhausted, "no memory for a character");
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(PsiStep, Step,
                              ffi::Ffi::Bind()
                                  .Arg<ffi::Buffer<ffi::U8>>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Arg<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::F32>>()
                                  .Ret<ffi::Buffer<ffi::PRED>>()
                                  .Ret<ffi::Buffer<ffi::F32>>());
