// sort: a stable radix sort of u32 keys with u32 values, 4 bits a pass.
//
//     place(key) = keys with a smaller digit + keys with the same digit in blocks, threads and runs before it
//
// A workgroup takes a block of 1024 keys, a thread a run of 8 neighbours. `count_digits` counts the digits of each block,
// the scan turns the counts into places, and in `scatter` each thread moves its own run, so equal keys keep their order.
// The device knows how many keys there are; blocks beyond them count nothing.

const SORT_THREADS = 128u;
const SORT_ITEMS = 8u;
const SORT_BLOCK = 1024u;
const DIGITS = 16u;
const COUNTERS = 2048u;              // one for each digit and thread, by digit

@group(1) @binding(0) var<storage, read> live: array<u32>;
@group(1) @binding(1) var<storage, read> keys_in: array<u32>;
@group(1) @binding(2) var<storage, read_write> digit_counts: array<u32>;

@group(1) @binding(2) var<storage, read> values_in: array<u32>;
@group(1) @binding(3) var<storage, read> digit_places: array<u32>;
@group(1) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(1) @binding(5) var<storage, read_write> values_out: array<u32>;

var<workgroup> digit_count: array<atomic<u32>, DIGITS>;
var<workgroup> counters: array<u32, COUNTERS>;
var<workgroup> thread_sums: array<u32, SORT_THREADS>;
var<workgroup> digit_starts: array<u32, DIGITS>;

fn digit_of(key: u32) -> u32 {
    return (key >> job.shift) & (DIGITS - 1u);
}

@compute @workgroup_size(SORT_THREADS)
fn count_digits(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
    let block = group_of(id, groups);
    let end = min(live[job.live], job.count);
    if (thread < DIGITS) {
        atomicStore(&digit_count[thread], 0u);
    }
    workgroupBarrier();
    for (var k = 0u; k < SORT_ITEMS; k++) {
        let at = block * SORT_BLOCK + k * SORT_THREADS + thread;
        if (at < end) {
            atomicAdd(&digit_count[digit_of(keys_in[at])], 1u);   // a sum of whole numbers has no order
        }
    }
    workgroupBarrier();
    if (thread < DIGITS && block < job.blocks) {
        digit_counts[thread * job.blocks + block] = atomicLoad(&digit_count[thread]);
    }
}

// Scans the counters of all digits and threads, and notes where each digit starts.
fn scan_counters(thread: u32) {
    let first = thread * DIGITS;     // 16 neighbours, all of one digit
    var mine = 0u;
    for (var k = 0u; k < DIGITS; k++) {
        mine += counters[first + k];
    }
    thread_sums[thread] = mine;
    workgroupBarrier();
    for (var reach = 1u; reach < SORT_THREADS; reach *= 2u) {
        var before = 0u;
        if (thread >= reach) {
            before = thread_sums[thread - reach];
        }
        workgroupBarrier();
        thread_sums[thread] += before;
        workgroupBarrier();
    }
    var start = thread_sums[thread] - mine;
    if (first % SORT_THREADS == 0u) {
        digit_starts[first / SORT_THREADS] = start;
    }
    for (var k = 0u; k < DIGITS; k++) {
        let here = counters[first + k];
        counters[first + k] = start;
        start += here;
    }
    workgroupBarrier();
}

@compute @workgroup_size(SORT_THREADS)
fn scatter(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
           @builtin(local_invocation_index) thread: u32) {
    let block = group_of(id, groups);
    let end = min(live[job.live], job.count);
    let first = block * SORT_BLOCK + thread * SORT_ITEMS;
    var keys: array<u32, SORT_ITEMS>;
    for (var digit = 0u; digit < DIGITS; digit++) {
        counters[digit * SORT_THREADS + thread] = 0u;
    }
    for (var k = 0u; k < SORT_ITEMS; k++) {
        if (first + k < end) {
            keys[k] = keys_in[first + k];
            counters[digit_of(keys[k]) * SORT_THREADS + thread] += 1u;
        }
    }
    workgroupBarrier();
    scan_counters(thread);
    for (var k = 0u; k < SORT_ITEMS; k++) {
        if (first + k < end) {
            let digit = digit_of(keys[k]);
            let own = digit * SORT_THREADS + thread;
            let place = digit_places[digit * job.blocks + block] + counters[own] - digit_starts[digit];
            counters[own] += 1u;
            keys_out[place] = keys[k];
            values_out[place] = values_in[first + k];
        }
    }
}
