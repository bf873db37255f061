#ifndef GADM_H
#define GADM_H

/* Made from runtime/c-api/src by cbindgen; do not edit. UPDATE_HEADER=1 .ci/test.py c-api writes it again. */

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#if defined(__cplusplus) && __cplusplus >= 201103L
#define GADM_ASSERT static_assert
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#define GADM_ASSERT _Static_assert
#endif
#if defined(GADM_ASSERT)
/* The library's records are laid out for these. */
GADM_ASSERT(sizeof(float) == 4 && sizeof(bool) == 1, "IEEE single precision and bool of one byte");
#endif


// Words of pointer size in a `gadm_policy`.
#define GADM_POLICY_WORDS 192

// Most action slots that a policy has; an array of this length takes every action.
#define GADM_MAX_ACTIONS 64

// Most observations that a policy has.
#define GADM_MAX_OBSERVATIONS 512

// Words of the set of allowed latents.
#define GADM_MASK_WORDS 8

// What a call did. The numbers stay as they are; new ones may be added.
enum gadm_status
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    // Done.
    GADM_STATUS_OK = 0,
    // A pointer that must not be is null.
    GADM_STATUS_NULL_POINTER = 1,
    // A pointer is not a multiple of its type's alignment; the image must start at a multiple of 4.
    GADM_STATUS_MISALIGNED_POINTER = 2,
    // Memory that is written overlaps memory that is read or written by the same call.
    GADM_STATUS_OVERLAPPING_MEMORY = 3,
    // A length does not fit into the address space.
    GADM_STATUS_BAD_LENGTH = 4,
    // No policy was loaded into this `gadm_policy`.
    GADM_STATUS_NOT_LOADED = 5,
    // There is no signal of this index.
    GADM_STATUS_NO_SUCH_INDEX = 6,
    // The image is shorter than the policy. `expected` and `found` are bytes.
    GADM_STATUS_TRUNCATED = 16,
    // The image is erased flash or zeros.
    GADM_STATUS_ERASED = 17,
    // The image starts with something else.
    GADM_STATUS_NOT_A_POLICY = 18,
    // The image was changed by a transfer in text mode.
    GADM_STATUS_TEXT_DAMAGE = 19,
    // The header's checksum is wrong. `expected` is stored, `found` computed.
    GADM_STATUS_HEADER_CHECKSUM = 20,
    // Format, numerics or runtime ABI are not known to this library. `index` is the format, `expected` the numerics,
    // `found` the ABI of the image.
    GADM_STATUS_VERSION = 21,
    // The weights are not int8. `found` is their kind.
    GADM_STATUS_WEIGHT_KIND = 22,
    // A checksum is wrong. `expected` is stored, `found` computed.
    GADM_STATUS_CHECKSUM = 23,
    // The interface hash is wrong. `expected` is stored, `found` computed.
    GADM_STATUS_INTERFACE_HASH = 24,
    // A section has the wrong length. `expected` and `found` are bytes.
    GADM_STATUS_SECTION_LENGTH = 25,
    // A field is out of range. `index` is its offset, `expected` the largest value.
    GADM_STATUS_FIELD = 26,
    // A number is not finite or out of range. `index` is its offset, `found` its bits.
    GADM_STATUS_NUMBER = 27,
    // A text is no text. `index` is its offset.
    GADM_STATUS_TEXT = 28,
    // A padding byte is not zero. `index` is its offset.
    GADM_STATUS_PADDING = 29,
    // A padding weight is not zero. `index` is 65536 times the layer plus the row.
    GADM_STATUS_PADDED_WEIGHT = 30,
    // A weight is out of range. `index` is 65536 times the layer plus the row.
    GADM_STATUS_WEIGHT = 31,
    // A sum could leave its range. `index` is 65536 times the layer plus the row.
    GADM_STATUS_BOUND = 32,
    // The image is refused for a reason that this library has no number for.
    GADM_STATUS_LOAD_OTHER = 47,
    // The observation has the wrong length. `expected` and `found` are values.
    GADM_STATUS_OBSERVATION_LENGTH = 48,
    // A value of the observation is NaN or infinite. `index` tells which.
    GADM_STATUS_NON_FINITE = 49,
    // The action array is too short. `expected` and `found` are values.
    GADM_STATUS_ACTION_LENGTH = 50,
    // The scratch memory is too short. `expected` and `found` are words of 32 bits.
    GADM_STATUS_SCRATCH_LENGTH = 51,
    // The step was refused for a reason that this library has no number for.
    GADM_STATUS_ACT_OTHER = 63,
    // The self-test chose another latent. `index` is the vector.
    GADM_STATUS_SELF_TEST_LATENT = 64,
    // The self-test computed another action. `index` is 65536 times the vector plus the slot, `expected` and `found` are
    // bits of floats.
    GADM_STATUS_SELF_TEST_ACTION = 65,
    // The self-test failed for a reason that this library has no number for.
    GADM_STATUS_SELF_TEST_OTHER = 79,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum gadm_status gadm_status;
#else
typedef int32_t gadm_status;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What an action slot holds.
enum gadm_action_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    // A number from `lo` to `hi`.
    GADM_ACTION_KIND_CONTINUOUS = 0,
    // One of `types`, counted from 0.
    GADM_ACTION_KIND_DISCRETE = 1,
    // 0 or 1.
    GADM_ACTION_KIND_BINARY = 2,
    // A kind that this library has no number for.
    GADM_ACTION_KIND_OTHER = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum gadm_action_kind gadm_action_kind;
#else
typedef int32_t gadm_action_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// A loaded policy, in memory of the caller. It points into the image, which must stay where it is and as it is. May be
// copied. The content is no concern of the caller's.
typedef struct gadm_policy {
    // Tells a loaded policy from other memory.
    uint64_t check;
    // Where the policy's bytes are.
    const uint8_t *image;
    // How many they are.
    size_t image_len;
    // What the library knows of it.
    size_t words[GADM_POLICY_WORDS];
} gadm_policy;

// What was wrong, beside the status. The status' comment tells which fields mean something.
typedef struct gadm_error {
    // The status that the call returned.
    gadm_status status;
    // Part of the image: 0 header, 1 payload, 2 interface, 3 input quantiser, 4 Q-network, 5 confidence network, 6 decoder,
    // 7 self-test, 8 provenance, 9 trailer; -1 none.
    int32_t section;
    // Where.
    uint32_t index;
    // What was expected.
    int64_t expected;
    // What was found.
    int64_t found;
} gadm_error;

// What a policy is and needs.
typedef struct gadm_spec {
    // Hash of names, units, ranges and order of the signals and of the control period.
    uint64_t interface_hash;
    // Bytes of the policy in the image.
    uint32_t image_len;
    // Sequence number; of two policies on a device the higher one is newer.
    uint32_t policy_seq;
    // Values of an observation.
    uint32_t obs_dim;
    // Values of an action.
    uint32_t action_dim;
    // Number of latents.
    uint32_t num_latents;
    // Time between two steps in microseconds.
    uint32_t control_period_us;
    // Scratch memory of a step in words of 32 bits.
    uint32_t scratch_words;
    // Multiply-accumulate operations of a step.
    uint32_t macs;
} gadm_spec;

// What a step decided.
typedef struct gadm_decision {
    // The latent that was chosen.
    uint16_t latent;
    // No latent passed the threshold; the most confident one, or all, were allowed instead.
    bool fallback;
    // An observation lay outside of its range and was clamped to it.
    bool clipped;
    // Q-logit of the chosen latent.
    int32_t q;
    // The allowed latents: latent k is bit k % 32 of word k / 32.
    uint32_t allowed[GADM_MASK_WORDS];
} gadm_decision;

// Text in the image, UTF-8, without a zero at its end.
typedef struct gadm_text {
    // First byte.
    const char *data;
    // Bytes.
    size_t len;
} gadm_text;

// One observation.
typedef struct gadm_observation_info {
    // Name.
    struct gadm_text name;
    // Unit.
    struct gadm_text unit;
    // Lower bound, in the unit.
    float lo;
    // Upper bound, in the unit.
    float hi;
    // For `gadm_act_q`: value that becomes 0, in the unit.
    float q_offset;
    // For `gadm_act_q`: steps per unit; the integer is the nearest to `(x - q_offset) * q_scale`, halves away from zero.
    float q_scale;
    // For `gadm_act_q`: largest integer; the smallest is `-q_max - 1`.
    int16_t q_max;
} gadm_observation_info;

// One action slot.
typedef struct gadm_action_info {
    // Name.
    struct gadm_text name;
    // Unit.
    struct gadm_text unit;
    // What it holds.
    gadm_action_kind kind;
    // Number of types of a discrete slot, else 0.
    uint32_t types;
    // Lower bound of a continuous slot, else 0.
    float lo;
    // Upper bound of a continuous slot, else 0.
    float hi;
    // Value for when there is no decision to act on.
    float safe;
} gadm_action_info;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Version of this interface: changes when a program that used it must be changed.
uint32_t gadm_abi_version(void);

// What a status means and what to do, as English text; never null.
const char *gadm_status_text(int32_t status);

// Checks the policy at the start of `image` and keeps what is needed to run it in `policy`. `len` may be longer than the
// policy, as a flash slot is. With any status but `GADM_STATUS_OK`, `policy` holds no policy.
//
// `error` may be null. Not checked: that the image stays readable and unchanged as long as the policy is used.
//
// # Safety
// `image` points to `len` readable bytes that stay as they are while `policy` is used; `policy` and `error` (or null)
// point to writable memory.
gadm_status gadm_load(struct gadm_policy *policy,
                      const uint8_t *image,
                      size_t len,
                      struct gadm_error *error);

// Forgets a policy, so that the image may be changed; null is allowed.
//
// # Safety
// `policy` is null or points to writable memory.
void gadm_unload(struct gadm_policy *policy);

// What the policy is and needs.
//
// # Safety
// `policy` was given to `gadm_load`, `spec` points to writable memory.
gadm_status gadm_get_spec(const struct gadm_policy *policy, struct gadm_spec *spec);

// Scratch memory of a step in words of 32 bits; 0 when no policy is loaded.
//
// # Safety
// `policy` is null or was given to `gadm_load`.
size_t gadm_scratch_words(const struct gadm_policy *policy);

// One control step: `obs_len` values in the units and order of the interface, `action_len` or fewer values out.
// With any status but `GADM_STATUS_OK`, `action` and `decision` are untouched. `decision` and `error` may be null.
//
// Not checked: that the memory is as long as said, and that no other task uses it at the same time.
//
// # Safety
// `policy` was given to `gadm_load`; the arrays are as long as said; `scratch`, `action`, `decision` and `error` are
// writable and used by nothing else during the call.
gadm_status gadm_act(const struct gadm_policy *policy,
                     const float *obs,
                     size_t obs_len,
                     uint32_t *scratch,
                     size_t scratch_words,
                     float *action,
                     size_t action_len,
                     struct gadm_decision *decision,
                     struct gadm_error *error);

// As `gadm_act`, with an observation that is already quantised by `q_offset`, `q_scale` and `q_max` of
// `gadm_observation`; no floating-point arithmetic before the action.
//
// # Safety
// As `gadm_act`.
gadm_status gadm_act_q(const struct gadm_policy *policy,
                       const int16_t *obs,
                       size_t obs_len,
                       uint32_t *scratch,
                       size_t scratch_words,
                       float *action,
                       size_t action_len,
                       struct gadm_decision *decision,
                       struct gadm_error *error);

// Runs the vectors of the policy: latent and every bit of the action must be as stored. Run it once after `gadm_load`; a
// policy that fails must not be run. `error` may be null.
//
// # Safety
// `policy` was given to `gadm_load`; `scratch` and `error` are writable and used by nothing else during the call.
gadm_status gadm_self_test(const struct gadm_policy *policy,
                           uint32_t *scratch,
                           size_t scratch_words,
                           struct gadm_error *error);

// Name, unit, range and quantiser of observation `index`.
//
// # Safety
// `policy` was given to `gadm_load`, `info` points to writable memory.
gadm_status gadm_observation(const struct gadm_policy *policy,
                             size_t index,
                             struct gadm_observation_info *info);

// Name, unit, kind, range and safe value of action slot `index`.
//
// # Safety
// `policy` was given to `gadm_load`, `info` points to writable memory.
gadm_status gadm_action(const struct gadm_policy *policy, size_t index, struct gadm_action_info *info);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* GADM_H */
