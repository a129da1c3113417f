// intersect: write tile and Gaussian of every pair, by Gaussian near to far; a stable sort by tile then leaves the list of
// every tile in depth order. The place of a pair before that sort is its slot, so the slots of a Gaussian are neighbours.
//
// A Gaussian never gets more slots than were counted, though another compilation of the same formula may round otherwise;
// slots that are left over get a tile beyond the last.

@group(1) @binding(0) var<storage, read> live: array<u32>;
@group(1) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(1) @binding(2) var<storage, read> order: array<u32>;
@group(1) @binding(3) var<storage, read> starts: array<u32>;
@group(1) @binding(4) var<storage, read_write> spans: array<vec2<u32>>;
@group(1) @binding(5) var<storage, read_write> tile_keys: array<u32>;
@group(1) @binding(6) var<storage, read_write> slot_of: array<u32>;
@group(1) @binding(7) var<storage, read_write> owner: array<u32>;

@group(1) @binding(1) var<storage, read> sorted_tiles: array<u32>;
@group(1) @binding(2) var<storage, read_write> tiles: array<u32>;

fn write_pair(slot: u32, tile: u32, i: u32) {
    tile_keys[slot] = tile;
    slot_of[slot] = slot;
    owner[slot] = i;
}

@compute @workgroup_size(64)
fn emit_pairs(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
              @builtin(local_invocation_index) thread: u32) {
    let k = group_of(id, groups) * 64u + thread;
    if (k >= min(job.count, live[job.live])) {
        return;
    }
    let i = order[k];
    var slot = starts[k];
    let end = min(slot + spans[i].x, arrayLength(&owner));
    spans[i].y = slot;
    let e = ellipse_of(records[4u * i], records[4u * i + 1u], records[4u * i + 3u]);
    for (var row = e.first; row <= e.last; row++) {
        for (var copy = 0; copy < COPIES; copy++) {
            let columns = run_of(e, row, copy);
            let first = u32(row) * view.tiles_x + u32(columns.x);
            for (var column = 0; column < columns.y && slot < end; column++) {
                write_pair(slot, first + u32(column), i);
                slot += 1u;
            }
        }
    }
    for (; slot < end; slot += 1u) {
        write_pair(slot, view.tiles, i);
    }
}

// Finds where the pairs of each tile begin, where those without a tile begin, and where they end.
@compute @workgroup_size(256)
fn find_ranges(@builtin(workgroup_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
    let tile = group_of(id, groups) * 256u + thread;
    if (tile >= job.count) {
        return;
    }
    var low = 0u;
    var high = min(live[job.live], arrayLength(&sorted_tiles));
    while (low < high) {
        let middle = (low + high) / 2u;
        if (sorted_tiles[middle] < tile) {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    tiles[tile] = low;
}
