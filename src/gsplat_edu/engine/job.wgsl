// What every kernel of the engine gets: the numbers of its pass, and the place of its workgroup.

struct Job {
    count: u32,    // items of the pass, its capacity where the device knows how many there are
    live: u32,     // place of the number of items in the buffer `live`
    blocks: u32,   // workgroups that have items
    shift: u32,    // lowest bit of the sort's digit; 1 for a composite without background
    first: u32,    // first workgroup of this dispatch: a long pass is dispatched in several stretches
}

@group(0) @binding(0) var<uniform> job: Job;

// Workgroups beyond the limit of one dimension continue in the second.
fn group_of(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return job.first + id.y * groups.x + id.x;
}
