// OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
// SPDX-License-Identifier: MIT

// AndersenThermostat with the step size that the device has. Particles that constraints join collide together, with the probability
// 1 - exp(-frequency h): that half of the squares of two normal numbers is below frequency h. There are as many numbers for groups,
// behind those for velocities.

KERNEL void collide(int numAtoms, int paddedNumAtoms, real frequency, real kT, GLOBAL mixed4* RESTRICT velm, GLOBAL const WIDE* RESTRICT control,
        GLOBAL const float4* RESTRICT normals, int firstNormal, GLOBAL const int* RESTRICT groups) {
    const real largest = 2*frequency*(real) control[STEP_SIZE];
    for (int i = GLOBAL_ID; i < numAtoms; i += GLOBAL_SIZE) {
        const mixed w = velm[i].w;
        const float4 chance = normals[firstNormal + paddedNumAtoms + groups[i]];
        if (w != 0 && chance.x*chance.x + chance.y*chance.y < largest) {
            const mixed size = sqrt(kT*w);
            const float4 normal = normals[firstNormal + i];
            velm[i] = make_mixed4(size*normal.x, size*normal.y, size*normal.z, w);
        }
    }
}
