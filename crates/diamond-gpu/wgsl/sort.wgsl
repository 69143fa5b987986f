// sort: one digit of eight bits of a stable radix sort; blocks of 2048 keys.
//
// The rank of a key among equal digits of a round of 256 is a count of bits: each key sets its lane's bit in a mask of its
// digit. Setting bits commutes, so ranks do not depend on who comes first.

@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
// By digit, then by block: how many; after the scan, where they go.
@group(0) @binding(5) var<storage, read_write> histogram: array<u32>;
// How many Gaussians, and how many entries.
@group(0) @binding(6) var<storage, read> counts: array<u32>;

// The digit's lowest bit; which of `counts` applies; whether values are the keys' places, not yet written anywhere.
override SHIFT: u32 = 0u;
override COUNT: u32 = 0u;
override FIRST: bool = false;

const ROUNDS: u32 = 8u;
const WORDS: u32 = 8u;
var<workgroup> digits: array<atomic<u32>, 256>;
var<workgroup> places: array<u32, 256>;
var<workgroup> masks: array<atomic<u32>, 2048>;

@compute @workgroup_size(256)
fn sort_count(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = linear_workgroup(id, grid);
    let blocks = arrayLength(&histogram) / 256u;
    atomicStore(&digits[lane], 0u);
    workgroupBarrier();
    for (var round = 0u; round < ROUNDS; round++) {
        let i = (block * ROUNDS + round) * 256u + lane;
        if i < counts[COUNT] {
            atomicAdd(&digits[(keys_in[i] >> SHIFT) & 255u], 1u);
        }
    }
    workgroupBarrier();
    if block < blocks {
        histogram[lane * blocks + block] = atomicLoad(&digits[lane]);
    }
}

@compute @workgroup_size(256)
fn sort_place(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) grid: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = linear_workgroup(id, grid);
    let blocks = arrayLength(&histogram) / 256u;
    for (var word = 0u; word < WORDS; word++) {
        atomicStore(&masks[lane * WORDS + word], 0u);
    }
    if block < blocks {
        places[lane] = histogram[lane * blocks + block];
    }
    let own_word = lane / 32u;
    let own_bit = 1u << (lane % 32u);
    for (var round = 0u; round < ROUNDS; round++) {
        workgroupBarrier();
        let i = (block * ROUNDS + round) * 256u + lane;
        let valid = i < counts[COUNT];
        var key = 0u;
        if valid {
            key = keys_in[i];
        }
        let digit = (key >> SHIFT) & 255u;
        if valid {
            atomicOr(&masks[digit * WORDS + own_word], own_bit);
        }
        workgroupBarrier();
        if valid {
            var place = places[digit];
            for (var word = 0u; word < own_word; word++) {
                place += countOneBits(atomicLoad(&masks[digit * WORDS + word]));
            }
            place += countOneBits(atomicLoad(&masks[digit * WORDS + own_word]) & (own_bit - 1u));
            keys_out[place] = key;
            if FIRST {
                values_out[place] = i;
            } else {
                values_out[place] = values_in[i];
            }
        }
        workgroupBarrier();
        // This lane's digit, for the next round.
        var count = 0u;
        for (var word = 0u; word < WORDS; word++) {
            count += countOneBits(atomicLoad(&masks[lane * WORDS + word]));
            atomicStore(&masks[lane * WORDS + word], 0u);
        }
        places[lane] += count;
    }
}
