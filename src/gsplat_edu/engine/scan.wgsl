// scan: running sums of u32, without the item itself, in place; the total goes to `live`.
//
//     out[i] = in[0] + ... + in[i - 1]
//
// Sums that do not fit stay at 2^32 - 1, so that a total that is too large can be told from a small one.
// Three passes: `reduce` sums blocks of 1024, `scan_sums` scans the sums in one workgroup, `scan_blocks` scans each block
// from its sum. No workgroup waits for another one.

const SCAN_THREADS = 256u;
const SCAN_ITEMS = 4u;               // per thread; a block has 1024
const SCAN_BLOCK = 1024u;

@group(1) @binding(0) var<storage, read> scan_in: array<u32>;
@group(1) @binding(1) var<storage, read_write> block_sums: array<u32>;

@group(1) @binding(0) var<storage, read_write> sums_to_scan: array<u32>;
@group(1) @binding(1) var<storage, read_write> totals: array<u32>;

@group(1) @binding(0) var<storage, read> block_starts: array<u32>;
@group(1) @binding(1) var<storage, read_write> scanned: array<u32>;

var<workgroup> partial: array<u32, SCAN_THREADS>;

fn plus(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, 0xffffffffu, sum < a);
}

// Returns the sum of `mine` over the threads before this one. All threads of the workgroup call it together; `partial`
// then has the sums up to and with each thread.
fn scan_threads(mine: u32, thread: u32) -> u32 {
    partial[thread] = mine;
    workgroupBarrier();
    for (var reach = 1u; reach < SCAN_THREADS; reach *= 2u) {
        var before = 0u;
        if (thread >= reach) {
            before = partial[thread - reach];
        }
        workgroupBarrier();
        partial[thread] = plus(partial[thread], before);
        workgroupBarrier();
    }
    return select(partial[max(thread, 1u) - 1u], 0u, thread == 0u);
}

@compute @workgroup_size(SCAN_THREADS)
fn reduce(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
          @builtin(local_invocation_index) thread: u32) {
    let block = group_of(id, groups);
    let first = block * SCAN_BLOCK + thread * SCAN_ITEMS;
    var mine = 0u;
    for (var k = 0u; k < SCAN_ITEMS; k++) {
        if (first + k < job.count) {
            mine = plus(mine, scan_in[first + k]);
        }
    }
    scan_threads(mine, thread);
    if (thread == SCAN_THREADS - 1u && block < job.blocks) {
        block_sums[block] = partial[thread];
    }
}

@compute @workgroup_size(SCAN_THREADS)
fn scan_sums(@builtin(local_invocation_index) thread: u32) {
    var before = 0u;                 // sum of the chunks before this one
    for (var chunk = 0u; chunk < job.blocks; chunk += SCAN_BLOCK) {
        let first = chunk + thread * SCAN_ITEMS;
        var items: array<u32, SCAN_ITEMS>;
        var mine = 0u;
        for (var k = 0u; k < SCAN_ITEMS; k++) {
            items[k] = 0u;
            if (first + k < job.blocks) {
                items[k] = sums_to_scan[first + k];
            }
            mine = plus(mine, items[k]);
        }
        var start = plus(before, scan_threads(mine, thread));
        for (var k = 0u; k < SCAN_ITEMS; k++) {
            if (first + k < job.blocks) {
                sums_to_scan[first + k] = start;
            }
            start = plus(start, items[k]);
        }
        before = plus(before, partial[SCAN_THREADS - 1u]);
        workgroupBarrier();          // the next chunk overwrites `partial`
    }
    if (thread == 0u) {
        totals[job.live] = before;
    }
}

@compute @workgroup_size(SCAN_THREADS)
fn scan_blocks(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
    let block = group_of(id, groups);
    let first = block * SCAN_BLOCK + thread * SCAN_ITEMS;
    var items: array<u32, SCAN_ITEMS>;
    var mine = 0u;
    for (var k = 0u; k < SCAN_ITEMS; k++) {
        items[k] = 0u;
        if (first + k < job.count) {
            items[k] = scanned[first + k];
        }
        mine = plus(mine, items[k]);
    }
    var start = scan_threads(mine, thread);
    if (block < job.blocks) {
        start = plus(start, block_starts[block]);
    }
    for (var k = 0u; k < SCAN_ITEMS; k++) {
        if (first + k < job.count) {
            scanned[first + k] = start;
        }
        start = plus(start, items[k]);
    }
}
