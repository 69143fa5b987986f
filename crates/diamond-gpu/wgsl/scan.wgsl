// scan: exclusive prefix sums, in blocks of 2048. Sums that do not fit 32 bits stay at the largest number.

@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> totals: array<u32>;

const ITEMS: u32 = 8u;
var<workgroup> partial: array<u32, 256>;

fn saturating_add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xFFFFFFFFu, a > 0xFFFFFFFFu - b);
}

// Each block of `values` becomes its own prefix sums; the block's sum goes to `totals`.
@compute @workgroup_size(256)
fn scan_blocks(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) count: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = linear_workgroup(id, count);
    let first = (block * 256u + lane) * ITEMS;
    let n = arrayLength(&values);
    var item: array<u32, 8>;
    var sum = 0u;
    for (var k = 0u; k < ITEMS; k++) {
        item[k] = sum;
        if first + k < n {
            sum = saturating_add(sum, values[first + k]);
        }
    }
    partial[lane] = sum;
    for (var step = 1u; step < 256u; step *= 2u) {
        workgroupBarrier();
        var before = 0u;
        if lane >= step {
            before = partial[lane - step];
        }
        workgroupBarrier();
        partial[lane] = saturating_add(before, partial[lane]);
    }
    workgroupBarrier();
    var before = 0u;
    if lane > 0u {
        before = partial[lane - 1u];
    }
    for (var k = 0u; k < ITEMS; k++) {
        if first + k < n {
            values[first + k] = saturating_add(before, item[k]);
        }
    }
    if lane == 255u && block < arrayLength(&totals) {
        totals[block] = partial[255];
    }
}

// Adds to each block of `values` what comes before it.
@compute @workgroup_size(256)
fn scan_add(
    @builtin(workgroup_id) id: vec3<u32>,
    @builtin(num_workgroups) count: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = linear_workgroup(id, count);
    if block >= arrayLength(&totals) {
        return;
    }
    let before = totals[block];
    let first = (block * 256u + lane) * ITEMS;
    for (var k = 0u; k < ITEMS; k++) {
        if first + k < arrayLength(&values) {
            values[first + k] = saturating_add(before, values[first + k]);
        }
    }
}
