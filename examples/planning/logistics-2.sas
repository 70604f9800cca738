begin_version
3
end_version
begin_metric
1
end_metric
5
begin_variable
var0
-1
2
Atom at(truck2, airport2)
Atom at(truck2, place2-1)
end_variable
begin_variable
var1
-1
2
Atom at(truck1, airport1)
Atom at(truck1, place1-1)
end_variable
begin_variable
var2
-1
2
Atom at(plane1, airport1)
Atom at(plane1, airport2)
end_variable
begin_variable
var3
-1
7
Atom at(package2, airport1)
Atom at(package2, airport2)
Atom at(package2, place1-1)
Atom at(package2, place2-1)
Atom in(package2, plane1)
Atom in(package2, truck1)
Atom in(package2, truck2)
end_variable
begin_variable
var4
-1
7
Atom at(package1, airport1)
Atom at(package1, airport2)
Atom at(package1, place1-1)
Atom at(package1, place2-1)
Atom in(package1, plane1)
Atom in(package1, truck1)
Atom in(package1, truck2)
end_variable
0
begin_state
0
0
0
3
2
end_state
begin_goal
2
3 2
4 3
end_goal
30
begin_operator
drive truck1 airport1 place1-1 city1
0
1
0 1 0 1
2
end_operator
begin_operator
drive truck1 place1-1 airport1 city1
0
1
0 1 1 0
2
end_operator
begin_operator
drive truck2 airport2 place2-1 city2
0
1
0 0 0 1
2
end_operator
begin_operator
drive truck2 place2-1 airport2 city2
0
1
0 0 1 0
2
end_operator
begin_operator
fly plane1 airport1 airport2
0
1
0 2 0 1
5
end_operator
begin_operator
fly plane1 airport2 airport1
0
1
0 2 1 0
5
end_operator
begin_operator
load package1 plane1 airport1
1
2 0
1
0 4 0 4
1
end_operator
begin_operator
load package1 plane1 airport2
1
2 1
1
0 4 1 4
1
end_operator
begin_operator
load package1 truck1 airport1
1
1 0
1
0 4 0 5
1
end_operator
begin_operator
load package1 truck1 place1-1
1
1 1
1
0 4 2 5
1
end_operator
begin_operator
load package1 truck2 airport2
1
0 0
1
0 4 1 6
1
end_operator
begin_operator
load package1 truck2 place2-1
1
0 1
1
0 4 3 6
1
end_operator
begin_operator
load package2 plane1 airport1
1
2 0
1
0 3 0 4
1
end_operator
begin_operator
load package2 plane1 airport2
1
2 1
1
0 3 1 4
1
end_operator
begin_operator
load package2 truck1 airport1
1
1 0
1
0 3 0 5
1
end_operator
begin_operator
load package2 truck1 place1-1
1
1 1
1
0 3 2 5
1
end_operator
begin_operator
load package2 truck2 airport2
1
0 0
1
0 3 1 6
1
end_operator
begin_operator
load package2 truck2 place2-1
1
0 1
1
0 3 3 6
1
end_operator
begin_operator
unload package1 plane1 airport1
1
2 0
1
0 4 4 0
1
end_operator
begin_operator
unload package1 plane1 airport2
1
2 1
1
0 4 4 1
1
end_operator
begin_operator
unload package1 truck1 airport1
1
1 0
1
0 4 5 0
1
end_operator
begin_operator
unload package1 truck1 place1-1
1
1 1
1
0 4 5 2
1
end_operator
begin_operator
unload package1 truck2 airport2
1
0 0
1
0 4 6 1
1
end_operator
begin_operator
unload package1 truck2 place2-1
1
0 1
1
0 4 6 3
1
end_operator
begin_operator
unload package2 plane1 airport1
1
2 0
1
0 3 4 0
1
end_operator
begin_operator
unload package2 plane1 airport2
1
2 1
1
0 3 4 1
1
end_operator
begin_operator
unload package2 truck1 airport1
1
1 0
1
0 3 5 0
1
end_operator
begin_operator
unload package2 truck1 place1-1
1
1 1
1
0 3 5 2
1
end_operator
begin_operator
unload package2 truck2 airport2
1
0 0
1
0 3 6 1
1
end_operator
begin_operator
unload package2 truck2 place2-1
1
0 1
1
0 3 6 3
1
end_operator
0
